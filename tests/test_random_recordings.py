from __future__ import annotations

import numpy as np
import pytest

from bask_data.core.geometry import view_change
from tests.random_recordings import HEIGHT, MOTIONS, PLACES, WIDTH, Errors, random_recording, tracked
from tests.scenes import Box, Scene, Sphere, intrinsics


@pytest.mark.parametrize("place", ["table", "room"])
def test_depth_is_that_of_the_analytic_scenes(place: str) -> None:
    rng = np.random.default_rng(3)
    bodies, target, distance = PLACES[place](rng)
    pose, K = MOTIONS["hand"](rng, 9, target, distance)[4], intrinsics(HEIGHT, WIDTH)
    boxes = [
        Box(tuple(half), np.linalg.inv(box)) for box, half in zip(bodies.box_from_world, bodies.halves, strict=True)
    ]
    balls = [Sphere(tuple(ball[:3]), ball[3]) for ball in bodies.balls]
    slow = Scene((*boxes, *balls), ()).render(K, pose, HEIGHT, WIDTH).depth
    np.testing.assert_allclose(bodies.depth(K, pose), slow, rtol=1e-5)


def test_depth_is_noisy_and_has_holes_as_stated() -> None:
    exact = random_recording(5, "wrist", "table", Errors(0, 0, 0, 0), n_frames=4)
    real = random_recording(5, "wrist", "table", Errors(position=0, angle_deg=0), n_frames=4)
    depth, truth = real.raw * real.depth_scale, exact.raw * exact.depth_scale
    measured = (depth > 0) & (truth > 0)
    assert measured.sum() / (truth > 0).sum() == pytest.approx(0.7, abs=0.03)
    assert (depth[measured] / truth[measured]).std() == pytest.approx(0.02, abs=0.002)


def test_poses_are_off_as_stated() -> None:
    exact = np.tile(np.eye(4), (4000, 1, 1))
    distance, angle = view_change(exact, tracked(exact, Errors(), np.random.default_rng(0)))
    assert np.sqrt((distance**2).mean()) == pytest.approx(0.005, rel=0.2)
    assert np.degrees(np.sqrt((angle**2).mean())) == pytest.approx(0.5, rel=0.2)


def test_the_same_seed_gives_the_same_recording() -> None:
    first, second = random_recording(8, n_frames=3), random_recording(8, n_frames=3)
    assert np.array_equal(first.raw, second.raw)
    assert np.array_equal(first.world_from_cameras, second.world_from_cameras)
