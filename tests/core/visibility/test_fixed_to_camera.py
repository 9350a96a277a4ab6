from __future__ import annotations

import numpy as np

from bask_data.core.visibility.fixed_to_camera import confirmed, fixed_to_camera
from tests.scenes import Scene, Sphere, orbit, tabletop
from tests.two_boxes import (
    BACK,
    CAMERA,
    DIRECTIONS,
    FRONT,
    HEIGHT,
    NOT_MEASURED,
    SCENE,
    TOLERANCE,
    WIDTH,
    K,
    mesh_of,
)


def gripper_frames(n_frames: int, moving: bool = True, with_pads: bool = True) -> tuple[list, np.ndarray]:
    """A wrist camera over the scene with two pads in its image which give no depth."""
    pads = np.zeros((HEIGHT, WIDTH), bool)
    if with_pads:
        pads[:50, :30] = pads[:50, -30:] = True
    scene, frames = tabletop(4, seed=2), []
    cameras = orbit(n_frames, radius=0.5) if moving else np.stack([orbit(1, radius=0.5)[0]] * n_frames)
    rng = np.random.default_rng(0)
    for camera in cameras:
        view = scene.render(K, camera, HEIGHT, WIDTH)
        rgb = np.where(pads[..., None], np.uint8(40), view.rgb).astype(float) + rng.normal(scale=3, size=view.rgb.shape)
        measured = ~pads & (rng.random(pads.shape) < 0.3)
        frames.append((np.clip(rgb, 0, 255).astype(np.uint8), measured))
    return frames, pads


def test_pads_that_ride_with_the_camera_are_found_from_colour_and_missing_depth() -> None:
    frames, pads = gripper_frames(12)
    found = fixed_to_camera(frames, HEIGHT, WIDTH)
    assert found[pads].mean() > 0.93
    assert found[~pads].mean() < 0.03


def test_nothing_is_taken_for_fixed_without_pads_or_without_motion() -> None:
    assert fixed_to_camera(gripper_frames(12, with_pads=False)[0], HEIGHT, WIDTH).mean() < 0.005
    assert not fixed_to_camera(gripper_frames(12, moving=False)[0], HEIGHT, WIDTH).any()
    assert not fixed_to_camera(gripper_frames(2)[0], HEIGHT, WIDTH).any()
    assert not fixed_to_camera([], HEIGHT, WIDTH).any()


def test_a_bare_wall_is_not_taken_for_fixed_because_its_depth_lies_on_the_mesh() -> None:
    frames, pads = gripper_frames(12)
    confirmed_everywhere = [(rgb, np.ones_like(pads)) for rgb, _ in frames]
    assert not fixed_to_camera(confirmed_everywhere, HEIGHT, WIDTH).any()


def test_depth_on_the_mesh_is_confirmed_and_a_hand_is_not() -> None:
    hand = Sphere((0.03, -0.25, 0.12), 0.03)
    view = Scene((*SCENE.objects, hand), SCENE.background).render(K, CAMERA, HEIGHT, WIDTH)
    seen = confirmed(mesh_of((FRONT, BACK), [1, 2]), view.depth, DIRECTIONS, CAMERA, TOLERANCE)
    assert not seen[view.instance == 3].any()
    assert seen[(view.instance < 3) & (view.depth > 0)].mean() > 0.999
    assert not confirmed(mesh_of((FRONT,), [1]), NOT_MEASURED, DIRECTIONS, CAMERA).any()
