from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from bask_data.core.geometry import (
    in_image,
    invert_rigid,
    nearest_rigid,
    pixel_grid,
    project,
    rigid_fault,
    rotation_angle,
    scale_intrinsics,
    scale_pixels,
    transform,
    unproject,
    view_change,
)

K = np.array([[500.0, 0.7, 319.5], [0.0, 510.0, 239.5], [0.0, 0.0, 1.0]])
finite = st.floats(-3, 3, allow_nan=False)


@st.composite
def rigid(draw: st.DrawFn) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec([draw(finite) for _ in range(3)]).as_matrix()
    matrix[:3, 3] = [draw(finite) for _ in range(3)]
    return matrix


@st.composite
def points_in_front(draw: st.DrawFn) -> np.ndarray:
    seed = draw(st.integers(0, 2**32 - 1))
    points = np.random.default_rng(seed).uniform(-1, 1, size=(20, 3))
    points[:, 2] += 2.0
    return points


@given(rigid())
def test_inverse_undoes(a_from_b: np.ndarray) -> None:
    np.testing.assert_allclose(invert_rigid(a_from_b) @ a_from_b, np.eye(4), atol=1e-12)


@given(points_in_front())
def test_project_undoes_unproject(points: np.ndarray) -> None:
    uv, z = project(points, K)
    np.testing.assert_allclose(unproject(uv, z, K), points, atol=1e-9)


@given(rigid(), rigid(), points_in_front())
def test_moving_world_and_camera_together_changes_nothing(
    world_from_camera: np.ndarray, motion: np.ndarray, points_world: np.ndarray
) -> None:
    before, _ = project(transform(invert_rigid(world_from_camera), points_world), K)
    moved = transform(invert_rigid(motion @ world_from_camera), transform(motion, points_world))
    after, _ = project(moved, K)
    np.testing.assert_allclose(before, after, rtol=1e-6, atol=1e-3)


def test_points_behind_the_camera_have_no_pixel() -> None:
    uv, z = project(np.array([[0.0, 0, -1], [0, 0, 0], [0, 0, 1]]), K)
    assert np.isnan(uv[:2]).all()
    assert uv[2].tolist() == [319.5, 239.5]
    assert z.tolist() == [-1, 0, 1]


def test_pixel_centres_are_integers() -> None:
    grid = pixel_grid(2, 3)
    assert grid[0, 0].tolist() == [0, 0]
    assert grid[1, 2].tolist() == [2, 1]
    edges = np.array([[-0.5, 0.0], [-0.51, 0.0], [2.49, 1.49], [2.5, 0.0], [np.nan, 0.0]])
    assert in_image(edges, 2, 3).tolist() == [True, False, True, False, False]


@given(points_in_front(), st.sampled_from([(240, 320), (480, 640), (96, 128), (960, 1280)]))
def test_scaled_intrinsics_project_to_scaled_pixels(points: np.ndarray, new_size: tuple[int, int]) -> None:
    size = (480, 640)
    uv, _ = project(points, K)
    scaled, _ = project(points, scale_intrinsics(K, size, new_size))
    np.testing.assert_allclose(scale_pixels(uv, size, new_size), scaled, atol=1e-9)


def test_scaling_keeps_the_edges_of_the_image() -> None:
    corners = np.array([[-0.5, -0.5], [639.5, 479.5]])
    assert scale_pixels(corners, (480, 640), (120, 160)).tolist() == [[-0.5, -0.5], [159.5, 119.5]]


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 1.0, np.pi - 1e-6, np.pi])
def test_rotation_angle_is_accurate_at_both_ends(angle: float) -> None:
    rotation = Rotation.from_rotvec(angle * np.array([0.6, 0.0, 0.8])).as_matrix()
    assert rotation_angle(rotation) == pytest.approx(angle, abs=1e-10)


def test_view_change_is_in_metres_and_radians() -> None:
    turned = np.eye(4)
    turned[:3, :3] = Rotation.from_euler("y", 90, degrees=True).as_matrix()
    turned[:3, 3] = [3.0, 0.0, 4.0]
    distance, angle = view_change(np.eye(4)[None], turned[None])
    assert distance[0] == pytest.approx(5.0)
    assert angle[0] == pytest.approx(np.pi / 2)


@pytest.mark.parametrize(
    ("matrix", "fault"),
    [
        (np.eye(4), ""),
        (np.full((4, 4), np.nan), "not finite"),
        (np.diag([1.0, 1, -1, 1]), "mirrored"),
        (np.diag([2.0, 2, 2, 1]), "scaled"),
        (np.diag([1.0, 1, 1, 2]), "last row"),
        (np.eye(4) + 0.5 * np.eye(4, k=1) * (np.arange(4) < 1)[:, None], "scaled"),
    ],
)
def test_what_is_no_rigid_transform_is_named(matrix: np.ndarray, fault: str) -> None:
    assert (fault in rigid_fault(matrix)) and bool(fault) == bool(rigid_fault(matrix))


def test_axes_that_are_not_perpendicular_are_named() -> None:
    matrix = np.eye(4)
    matrix[:3, 0] = np.array([1.0, 1.0, 0.0]) / np.sqrt(2)
    assert "not perpendicular" in rigid_fault(matrix)


@given(rigid(), st.integers(0, 2**32 - 1))
def test_rounding_is_taken_out(matrix: np.ndarray, seed: int) -> None:
    rounded = matrix.copy()
    rounded[:3, :3] += np.random.default_rng(seed).uniform(-1e-4, 1e-4, size=(3, 3))
    mended = nearest_rigid(rounded)
    assert rigid_fault(mended, tolerance=1e-12) == ""
    np.testing.assert_allclose(mended, matrix, atol=5e-4)
