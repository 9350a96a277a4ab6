from __future__ import annotations

import numpy as np
import pytest

from bask_data.core.workspace import estimated_workspace, sampled_points
from tests.scenes import Box, Plane, Scene, Sphere, intrinsics, look_at, orbit

HEIGHT, WIDTH = 120, 160
K = intrinsics(HEIGHT, WIDTH)
SCENE = Scene(
    (Sphere((0.0, 0.0, 0.05), 0.05), Box((0.03, 0.04, 0.02), look_at((0.12, 0.05, 0.02)))), (Plane(extent=0.3),)
)


def points_of(scene: Scene, camera: np.ndarray, n_points: int = 5000) -> np.ndarray:
    return sampled_points(scene.render(K, camera, HEIGHT, WIDTH).depth, K, camera, n_points)


def test_estimated_workspace_holds_what_cameras_share_and_not_a_glance_at_a_far_wall() -> None:
    table_and_wall = Scene(SCENE.objects, (Plane(extent=0.3), Plane((1.0, 0.0, 0.0), 3.0, (-3.0, 0.0, 0.5), 0.3)))
    cameras = [*orbit(9, radius=0.5), look_at((0.0, 0.0, 0.5), (-3.0, 0.0, 0.5))]
    clouds = [points_of(table_and_wall, camera) for camera in cameras]
    assert min(cloud[:, 0].min() for cloud in clouds) == pytest.approx(-3.0, abs=1e-5)
    box = estimated_workspace(clouds)
    assert box is not None
    assert (box[0] < [-0.2, -0.2, 0.0]).all()
    assert (box[0] > [-0.4, -0.4, -0.1]).all()
    assert (box[1] > [0.15, 0.15, 0.08]).all()
    assert (box[1] < [0.4, 0.4, 0.2]).all()


def test_workspace_of_one_frame_is_what_it_measured_and_of_none_is_none() -> None:
    box = estimated_workspace([points_of(SCENE, orbit(1, radius=0.5)[0])])
    assert box is not None
    assert (box[0] < -0.2).any()
    assert estimated_workspace([sampled_points(np.zeros((HEIGHT, WIDTH), np.float32), K, np.eye(4))]) is None


def test_sampled_points_lie_on_the_surface() -> None:
    points = points_of(SCENE, orbit(1)[0], n_points=500)
    assert 500 <= len(points) < 1000
    assert SCENE.surface_distance(points).max() < 1e-6
