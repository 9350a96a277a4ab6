from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, is_dataclass, replace
from typing import Any

import numpy as np
import pytest
import torch

from bask_data.core import bayes_filter as core
from bask_data.core.bayes_filter import (
    DiscreteSettings,
    ExpectationSettings,
    Motion,
    Observation,
    ParticleSettings,
    Settings,
)
from bask_data.core.discrete_filter import DiscreteBelief
from bask_data.nn.filters import belief_from, belief_on, estimate_from, observation_on, step

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


def arrays(of: Any, name: str = "") -> Iterator[tuple[str, np.ndarray | None]]:
    """Every array of a belief or an estimate."""
    if is_dataclass(of):
        for field in fields(of):
            yield from arrays(getattr(of, field.name), f"{name}.{field.name}")
    elif isinstance(of, tuple):
        for i, one in enumerate(of):
            yield from arrays(one, f"{name}[{i}]")
    else:
        yield name, of


def held_together(ours: Any, theirs: Any) -> None:
    """Every array of a belief or an estimate is the same to 1e-5."""
    for (name, expected), (same_name, got) in zip(arrays(ours), arrays(theirs), strict=True):
        assert name == same_name
        assert (expected is None) == (got is None)
        if expected is not None and got is not None:
            assert got.shape == expected.shape
            np.testing.assert_allclose(got, expected, rtol=1e-5, atol=1e-7, err_msg=name)


def frames_at(i: int) -> list[Observation | None]:
    """A camera that moves and turns, and one that stands; its maps are coarser. Frames and depth go missing."""
    given: list[Observation | None] = [
        wall(camera_at(0.02 * i, 0.05 * i), i, False),
        wall(camera_at(0.3, -0.1), 99, True),
    ]
    if i in (4, 5, 8):
        given[i % 2] = None
    if i in (0, 7):
        given = [None, None]
    blind = {1: (0, 1), 3: (0,), 9: (0, 1), 10: (1,)}.get(i, ())
    return [
        replace(seen, depth=0 * seen.depth) if camera in blind and seen is not None else seen
        for camera, seen in enumerate(given)
    ]


def steps_together(settings: Settings, n: int, device: str = "cpu") -> Iterator[tuple[Any, core.Estimate]]:
    """Belief and estimate of each frame, held against those of the tensors."""
    ours: Any = None
    theirs: Any = None
    rng, same = np.random.default_rng(5), np.random.default_rng(5)
    for i in range(n):
        given = frames_at(i)
        motion = Motion(gripper_at(0.02 * i - 0.1, 0.0), gripper_at(0.02 * i - 0.08, 0.1)) if i else None
        ours, estimate = core.step(ours, given, motion, rng, settings, len(PLACES))
        on_device = [None if seen is None else observation_on(seen, device) for seen in given]
        theirs, twin = step(theirs, on_device, motion, same, settings, len(PLACES), device)
        assert twin.mean.device.type == device
        assert (ours is None) == (theirs is None)
        if theirs is not None:
            held_together(ours, belief_from(theirs))
        held_together(estimate, estimate_from(twin))
        assert rng.bit_generator.state == same.bit_generator.state
        yield ours, estimate


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
def test_particles_on_tensors_with_the_same_random_numbers(settings: ParticleSettings, device: str) -> None:
    beliefs = [belief for belief, _ in steps_together(settings, 14, device)]
    assert beliefs[1] is None
    assert any(one.held.any() for one in beliefs[2:])
    assert any(np.isfinite(one.lookalikes).sum() > 9 for one in beliefs[2:]) == (settings.n_lookalikes > 0)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(
    "settings",
    [
        DiscreteSettings(),
        DiscreteSettings(grid=(13, 22), walk_px=2.5),
        DiscreteSettings(grid=(30, 26), tau=0.4, outside_area=0.3),
        core.settings_named("discrete", "paper"),
    ],
)
def test_the_discrete_filter_on_tensors(settings: DiscreteSettings, device: str) -> None:
    """Grids as the maps, coarser, and between the two cameras' maps."""
    results = list(steps_together(settings, 14, device))
    cameras = [one for belief, _ in results[1:] for one in belief.cameras if one is not None]
    assert max(one.outside.max() for one in cameras) > (0.5 if settings.tau == 0.4 else 0.01)
    assert min(one.outside.min() for one in cameras[-2:]) < 0.5
    assert np.isnan(results[1][1].mean).all()
    assert np.isfinite(results[-1][1].mean).all()


@pytest.mark.parametrize("device", DEVICES)
def test_the_expectation_on_tensors(device: str) -> None:
    results = list(steps_together(ExpectationSettings(), 11, device))
    assert np.isnan(results[1][1].mean).all()
    np.testing.assert_array_equal(results[7][1].mean, results[6][1].mean)


@pytest.mark.parametrize("settings", [DiscreteSettings(grid=(13, 22)), DiscreteSettings(walk_px=0.0, restart=0.0)])
def test_a_keypoint_that_is_nowhere_in_the_image(settings: DiscreteSettings) -> None:
    """It keeps its last place; an image in which it has no probability at all still has a centre."""
    seen = wall(np.eye(4), 0, False)
    belief, _ = core.step(None, [seen], None, np.random.default_rng(0), settings)
    assert isinstance(belief, DiscreteBelief)
    camera = belief.cameras[0]
    assert camera is not None
    gone = replace(belief, cameras=(replace(camera, inside=0 * camera.inside, outside=np.ones(3)),))
    ours, estimate = core.step(gone, [seen], None, np.random.default_rng(0), settings)
    theirs, twin = step(belief_on(gone), [observation_on(seen)], None, np.random.default_rng(0), settings)
    assert theirs is not None
    held_together(ours, belief_from(theirs))
    held_together(estimate, estimate_from(twin))
    np.testing.assert_array_equal(estimate.mean, belief.estimate.mean)


@pytest.mark.parametrize("settings", [ExpectationSettings(), DiscreteSettings(), ParticleSettings(n_particles=50)])
def test_a_belief_comes_back_from_its_device_as_it_went(settings: Settings) -> None:
    """A camera that has not given a frame yet included."""
    belief, _ = core.step(None, [wall(np.eye(4), 0, False), None], None, np.random.default_rng(0), settings)
    assert belief is not None
    back = belief_from(belief_on(belief))
    assert type(back) is type(belief)
    for (name, expected), (_, got) in zip(arrays(belief), arrays(back), strict=True):
        np.testing.assert_array_equal(got, expected, err_msg=name)
