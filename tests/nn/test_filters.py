from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
import torch

from bask_data.core import particle_filter as core
from bask_data.core.heatmap import Motion, Observation
from bask_data.core.particle_filter import ParticleBelief, ParticleSettings
from bask_data.nn.filters import belief_from, belief_on, observation_on, particle_step

DEVICES = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
K = np.array([[60.0, 0.5, 29.5], [0, 62.0, 19.5], [0, 0, 1]])
PLACES = np.array([[0.05, 0.02, 1.0], [-0.2, -0.05, 1.0], [0.3, 0.1, 1.0]])


def camera_at(x: float, turn: float) -> np.ndarray:
    world_from_camera = np.eye(4)
    world_from_camera[0, 3] = x
    c, s = np.cos(turn), np.sin(turn)
    world_from_camera[:3, :3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]]
    return world_from_camera


def gripper_at(x: float, turn: float) -> np.ndarray:
    """A gripper at the wall, near the keypoints."""
    world_from_gripper = camera_at(x, turn)
    world_from_gripper[2, 3] = 1.0
    return world_from_gripper


def wall(world_from_camera: np.ndarray, seed: int, coarse: bool) -> Observation:
    """A noisy wall with holes in its depth; each keypoint has a twin half a metre beside it."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[:40, :60]
    y = (v - K[1, 2]) / K[1, 1]
    rays = np.stack([(u - K[0, 2] - K[0, 1] * y) / K[0, 0], y, np.ones((40, 60))], -1) @ world_from_camera[:3, :3].T
    depth = 1.0 / rays[..., 2]
    points = world_from_camera[:3, 3] + rays * depth[..., None]
    apart = np.minimum(*(((points - PLACES[:, None, None] - [x, 0, 0]) ** 2).sum(-1) for x in (0.0, 0.5)))
    z = (1 - np.exp(-apart / (2 * 0.05**2)) + 0.05 * rng.random(apart.shape)).astype(np.float32)
    depth = (depth * (1 + 0.01 * rng.standard_normal(depth.shape))).astype(np.float32)
    depth[rng.random(depth.shape) < 0.1] = 0
    depth[10:20, 40:50] *= 0.7
    return Observation(z[:, ::2, ::2] if coarse else z, depth, K, world_from_camera)


def held_together(ours: object, theirs: object) -> None:
    """Every array is the same to 1e-5, those of the belief and of the estimate."""
    for field in fields(theirs):
        got = getattr(theirs, field.name).cpu().numpy()
        expected = getattr(ours, field.name)
        assert got.shape == expected.shape
        np.testing.assert_allclose(got, expected, rtol=1e-5, atol=1e-5, err_msg=field.name)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(
    "settings",
    [
        ParticleSettings(n_particles=500),
        ParticleSettings(n_particles=300, tau=0.05, resampling="systematic", resample_below=0.7, gripper_turns=False),
        ParticleSettings(
            n_particles=300, n_lookalikes=0, redraw_share=0.05, redraw_mass=0.05, hidden_without_depth=1.0
        ),
    ],
)
def test_tensors_give_what_arrays_give_with_the_same_random_numbers(settings: ParticleSettings, device: str) -> None:
    ours = theirs = None
    rng, same = np.random.default_rng(5), np.random.default_rng(5)
    n_lookalikes, n_held = 0, 0
    for i in range(14):
        given: list[Observation | None] = [
            wall(camera_at(0.0, 0.05 * i), i, False),
            wall(camera_at(0.3, -0.1), 99, True),
        ]
        if i in (5, 6, 9):
            given[i % 2] = None
        if i == 8:
            given = [None, None]
        motion = Motion(gripper_at(0.02 * i - 0.1, 0.0), gripper_at(0.02 * i - 0.08, 0.1)) if i else None
        ours, estimate = core.particle_step(ours, given, motion, rng, settings)
        on_device = [None if seen is None else observation_on(seen, device) for seen in given]
        theirs, twin = particle_step(theirs, on_device, motion, same, settings)
        held_together(ours, theirs)
        held_together(estimate, twin)
        assert rng.bit_generator.state == same.bit_generator.state
        n_held += int(ours.held.sum())
        n_lookalikes = max(n_lookalikes, int(np.isfinite(ours.lookalikes[..., 0]).sum()))
    assert n_held
    assert (n_lookalikes > 3) == (settings.n_lookalikes > 0)


def test_a_belief_comes_back_from_its_device_as_it_went() -> None:
    belief, _ = core.particle_step(None, [wall(np.eye(4), 0, False)], None, np.random.default_rng(0))
    back = belief_from(belief_on(belief))
    for field in fields(ParticleBelief):
        np.testing.assert_array_equal(getattr(back, field.name), getattr(belief, field.name))


def test_nothing_can_be_drawn_without_depth() -> None:
    seen = wall(np.eye(4), 0, False)
    blind = observation_on(replace(seen, depth=0 * seen.depth))
    with pytest.raises(ValueError, match="no camera has any"):
        particle_step(None, [blind, None], None, np.random.default_rng(0), ParticleSettings())
