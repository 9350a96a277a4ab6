from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bask_data.core.geometry import in_image, invert_rigid, pixel_grid, project, scale_intrinsics, transform, unproject
from bask_data.core.registration import color_at_depth_size, labels_at_depth_size, registered_depth
from tests.scenes import Scene, intrinsics, orbit, tabletop

SIZE, HALF = (480, 640), (240, 320)
K, HALF_K = intrinsics(*SIZE), intrinsics(*HALF)


def rigid(rotation_vector: tuple[float, float, float], translation: tuple[float, float, float]) -> np.ndarray:
    a_from_b = np.eye(4)
    a_from_b[:3, :3] = cv2.Rodrigues(np.array(rotation_vector, np.float64))[0]
    a_from_b[:3, 3] = translation
    return a_from_b


def seen_by_both(
    scene: Scene, depth: np.ndarray, world_from_color: np.ndarray, world_from_depth: np.ndarray
) -> np.ndarray:
    """Pixels of the colour camera whose surface the depth camera sees, by casting a ray at each from there."""
    points = transform(world_from_color, unproject(pixel_grid(*SIZE).reshape(-1, 2), depth.ravel().astype(float), K))
    at = transform(invert_rigid(world_from_depth), points)
    uv, z = project(at, HALF_K)
    rays = at / at[:, 2:] @ world_from_depth[:3, :3].T
    hits = np.stack([body.cast(world_from_depth[:3, 3], rays) for body in scene.background + scene.objects]).min(axis=0)
    return (in_image(uv, *HALF) & (depth.ravel() > 0) & (np.abs(hits - z) < 1e-3)).reshape(SIZE)


# A second camera, 25 mm beside and at half size -----------------------------------------------------------------------


@pytest.mark.parametrize("i_view", range(4))
@pytest.mark.parametrize("baseline", [0.025, -0.025])
def test_depth_of_a_camera_beside_is_exact_has_no_holes_and_hides_what_is_behind(i_view: int, baseline: float) -> None:
    scene = tabletop(6)
    world_from_color = orbit(4, radius=0.6, elevation_deg=(25.0, 60.0))[i_view]
    color_from_depth = rigid((0.01, -0.02, 0.03), (baseline, 0.0, 0.0))
    world_from_depth = world_from_color @ color_from_depth
    truth = scene.render(K, world_from_color, *SIZE)
    measured = scene.render(HALF_K, world_from_depth, *HALF).depth
    found = registered_depth(measured, HALF_K, K, SIZE, color_from_depth)
    is_found = found > 0
    error = np.where(truth.depth > 0, found / np.maximum(truth.depth, 1e-6) - 1, np.inf)
    assert (np.abs(error)[is_found] < 0.01).mean() > 0.999
    # One centimetre above the table, the background is 10 mm behind an object.
    background_shows = is_found & (truth.instance > 0) & (found > truth.depth * 1.01 + 0.01)
    assert not background_shows.any()
    object_is_smeared = is_found & (found < truth.depth * 0.99 - 0.01)
    assert object_is_smeared.mean() < 1e-5
    both = seen_by_both(scene, truth.depth, world_from_color, world_from_depth)
    assert is_found[both].mean() > 0.97
    assert (is_found & ~both).mean() < 1e-4


# Planes are met exactly -----------------------------------------------------------------------------------------------


@given(
    normal=st.tuples(st.floats(-0.45, 0.45), st.floats(-0.45, 0.45)),
    turn=st.tuples(*[st.floats(-0.15, 0.15)] * 3),
    move=st.tuples(*[st.floats(-0.1, 0.1)] * 3),
    n_rows=st.integers(20, 150),
)
def test_a_plane_is_exact_and_whole_wherever_depth_was_measured(
    normal: tuple[float, float], turn: tuple[float, float, float], move: tuple[float, float, float], n_rows: int
) -> None:
    size, color_size = (60, 80), (n_rows, n_rows * 4 // 3)
    depth_K, color_K = intrinsics(*size), intrinsics(*color_size)
    plane = np.array([*normal, 1.0])  # plane . point = 1 metre, in the depth camera's frame
    rays = unproject(pixel_grid(*size), np.ones(size), depth_K)
    color_from_depth = rigid(turn, move)
    found = registered_depth((1 / (rays @ plane)).astype(np.float32), depth_K, color_K, color_size, color_from_depth)
    depth_from_color = invert_rigid(color_from_depth)
    rays = unproject(pixel_grid(*color_size), np.ones(color_size), color_K)
    truth = (1 - plane @ depth_from_color[:3, 3]) / (rays @ depth_from_color[:3, :3].T @ plane)
    uv, _ = project(transform(depth_from_color, rays * truth[..., None]), depth_K)
    u, v = uv[..., 0], uv[..., 1]
    inside = (truth > 0) & (u > 0.01) & (v > 0.01) & (u < size[1] - 1.01) & (v < size[0] - 1.01)
    outside = ~((u > -0.01) & (v > -0.01) & (u < size[1] - 0.99) & (v < size[0] - 0.99))
    assert np.abs(found / truth - 1)[inside].max(initial=0) < 1e-5
    assert (found[outside] == 0).all()


def test_a_floor_seen_at_a_small_angle_is_whole() -> None:
    rays = unproject(pixel_grid(*HALF), np.ones(HALF), HALF_K)
    up = np.deg2rad(26)  # The floor 1.5 m below a camera whose upper edge looks 3 degrees below the horizon.
    slope = rays @ np.array([0, np.cos(up), np.sin(up)])
    depth = (1.5 / slope).astype(np.float32)
    assert np.diff(depth, axis=0).min() < -1.5 * (0.01 + 0.01 * depth.max())
    found = registered_depth(depth, HALF_K, K, SIZE, rigid((0, 0, 0), (0.025, 0, 0)))
    rays = unproject(pixel_grid(*SIZE), np.ones(SIZE), K)
    truth = 1.5 / (rays @ np.array([0, np.cos(up), np.sin(up)]))
    assert np.abs(found / truth - 1)[found > 0].max() < 0.01
    assert (found > 0)[4:-4, 60:-4].mean() > 0.99


def beside(column: float, depth: float) -> float:
    """Column of the image of a colour camera 25 mm to the left."""
    points_depth = unproject(np.array([[column, 120.0]]), np.array([depth]), HALF_K)
    return float(project(transform(rigid((0, 0, 0), (0.025, 0, 0)), points_depth), K)[0][0, 0])


# Edges, wires, holes --------------------------------------------------------------------------------------------------


def test_a_wire_one_pixel_wide_stays_in_front_of_its_wall() -> None:
    depth = np.full(HALF, 1.0, np.float32)
    depth[:, 160] = 0.5
    found = registered_depth(depth, HALF_K, K, SIZE, rigid((0, 0, 0), (0.025, 0, 0)))
    wire = np.isclose(found, 0.5)
    at = np.arange(SIZE[1])[wire[240]]
    expected = beside(160, 0.5)
    assert len(at) == 2
    assert abs(at.mean() - expected) <= 0.5
    assert set(np.unique(found)) == {0.0, 0.5, 1.0}
    around = found[240, at[0] - 2 : at[-1] + 3]
    assert (around < 0.6).all(), "the wall shows where the wire may be"


def test_from_the_same_centre_no_measured_pixel_is_lost_beside_an_edge() -> None:
    depth = np.full(HALF, 1.0, np.float32)
    depth[60:180, 100:200] = 0.6
    depth[30:34, 30:34] = 0
    found = registered_depth(depth, HALF_K, HALF_K, HALF, np.eye(4))
    assert np.allclose(found[depth > 0], depth[depth > 0], atol=1e-6)
    assert not found[31:33, 31:33].any()


def test_nothing_is_drawn_across_a_jump_in_depth() -> None:
    depth = np.full(HALF, 1.0, np.float32)
    depth[60:180, 100:200] = 0.6
    found = registered_depth(depth, HALF_K, K, SIZE, rigid((0, 0, 0), (-0.025, 0.01, 0)))
    assert np.isin(np.round(found, 5), np.float32([0, 0.6, 1.0])).all()


def test_a_near_surface_that_ends_with_the_image_hides_what_is_behind_it_beyond() -> None:
    # 25 mm to the left, the colour camera sees more of the near surface, and the depth camera the wall behind.
    depth = np.full(HALF, 2.0, np.float32)
    depth[:, :2] = 0.4
    color_from_depth = rigid((0, 0, 0), (0.025, 0, 0))
    found = registered_depth(depth, HALF_K, K, SIZE, color_from_depth)
    assert not (found[:, : int(beside(1, 0.4))] > 1).any()


def test_missing_measurements_are_missing_and_invent_nothing() -> None:
    depth = np.full(HALF, 0.8, np.float32)
    depth[100:140, 100:150] = np.float32([0, np.nan, np.inf, -1, -np.inf] * 10)
    found = registered_depth(depth, HALF_K, K, SIZE, rigid((0, 0, 0), (0.001, 0, 0)))
    assert set(np.unique(np.round(found, 6))) == {0, np.float32(0.8)}
    assert (found[4:-4, 4:-4] > 0).sum() < found[4:-4, 4:-4].size - 4 * 39 * 49
    assert not found[202:278, 204:296].any()
    assert not registered_depth(np.zeros(HALF, np.float32), HALF_K, K, SIZE, np.eye(4)).any()


def test_rows_columns_and_pixels_missing_inside_a_surface_leave_no_gaps_and_wider_ones_no_larger_gaps() -> None:
    depth = np.full(HALF, 0.8, np.float32)
    depth[5:-5:10, 5:-5:10] = 0
    depth[100], depth[:, 100] = 0, 0
    depth[200:210, 200:210] = 0
    found = registered_depth(depth, HALF_K, K, SIZE, rigid((0, 0, 0), (0.025, 0, 0)))
    assert np.allclose(found[found > 0], 0.8)
    gap = found[4:-4, 60:-4] == 0
    assert 4 * 10 * 10 * 0.9 < gap.sum() < 4 * 11 * 11


def test_noise_of_a_sensor_at_a_distance_leaves_few_holes() -> None:
    rng = np.random.default_rng(0)
    depth = (3 + 0.03 * rng.standard_normal(HALF)).astype(np.float32)
    found = registered_depth(depth, HALF_K, K, SIZE, rigid((0, 0, 0), (0.025, 0, 0)))
    assert (found > 0)[4:-4, 20:-4].mean() > 0.97


def test_a_camera_that_looks_the_other_way_or_stands_in_the_surface_sees_nothing_of_it() -> None:
    depth = np.full(HALF, 0.5, np.float32)
    assert not registered_depth(depth, HALF_K, K, SIZE, rigid((0, np.pi, 0), (0, 0, 0))).any()
    assert not registered_depth(depth, HALF_K, K, SIZE, rigid((0, 0, 0), (0, 0, -0.49999))).any()


# Colour at the size of depth ------------------------------------------------------------------------------------------


def picture(height: int, width: int) -> np.ndarray:
    small = np.random.default_rng(0).integers(0, 256, (height // 3, width // 3, 3)).astype(np.uint8)
    return cv2.resize(small, (width, height), interpolation=cv2.INTER_CUBIC)


@pytest.mark.parametrize("size", [(64, 48), (50, 37), (17, 23)])
def test_colour_is_the_mean_of_the_area_of_a_pixel_of_depth(size: tuple[int, int]) -> None:
    rgb = picture(192, 144)
    color_K = intrinsics(192, 144)
    found = color_at_depth_size(rgb, color_K, scale_intrinsics(color_K, (192, 144), size), size)
    expected = cv2.resize(rgb, size[::-1], interpolation=cv2.INTER_AREA)
    assert np.abs(found.astype(int) - expected).max() <= 1


def test_colour_follows_the_intrinsics_and_not_the_ratio_of_sizes() -> None:
    rgb = picture(192, 144)
    color_K = intrinsics(192, 144)
    cropped_K = color_K.copy()
    cropped_K[:2, 2] -= [24, 16]
    depth_K = scale_intrinsics(cropped_K, (128, 96), (32, 24))
    found = color_at_depth_size(rgb, color_K, depth_K, (32, 24))
    expected = cv2.resize(rgb[16:144, 24:120], (24, 32), interpolation=cv2.INTER_AREA)
    assert np.abs(found.astype(int) - expected).max() <= 1


def test_smaller_colour_is_interpolated_and_outside_it_is_black() -> None:
    rgb = np.zeros((40, 40, 3), np.uint8)
    rgb[..., 0], rgb[..., 1] = 5 * np.arange(40), 5 * np.arange(40)[:, None]
    color_K = np.array([[50.0, 0, 19.5], [0, 50, 19.5], [0, 0, 1]])
    depth_K = np.array([[130.0, 0, 62.1], [0, 140, 50.1], [0, 0, 1]])
    found = color_at_depth_size(rgb, color_K, depth_K, (130, 120))
    uv, _ = project(unproject(pixel_grid(130, 120), np.ones((130, 120)), depth_K), color_K)
    inside = in_image(uv, 40, 40)
    assert not inside.all()
    assert not found[~inside].any()
    assert np.abs(found[..., :2] - 5 * uv.clip(0, 39))[inside].max() <= 0.51


@pytest.mark.parametrize("f", [20.0, 50.0, 130.0])
def test_labels_at_the_size_of_depth_are_those_of_the_nearest_pixel(f: float) -> None:
    labels = np.random.default_rng(0).integers(1, 256, (40, 44)).astype(np.uint8)
    color_K = np.array([[50.0, 0, 19.3], [0, 52, 18.9], [0, 0, 1]])
    depth_K = np.array([[f, 0, 30.1], [0, f, 21.2], [0, 0, 1]])
    found = labels_at_depth_size(labels, color_K, depth_K, (50, 60))
    uv, _ = project(unproject(pixel_grid(50, 60), np.ones((50, 60)), depth_K), color_K)
    u, v = np.rint(uv).astype(int).reshape(-1, 2).T
    expected = [labels[b, a] if 0 <= a < 44 and 0 <= b < 40 else 0 for a, b in zip(u, v, strict=True)]
    assert found.ravel().tolist() == expected


def test_cameras_of_different_skew_are_refused() -> None:
    skewed = K + np.array([[0, 3.0, 0], [0, 0, 0], [0, 0, 0]])
    with pytest.raises(ValueError, match="expected the same skew, got 3 of colour, 0 of depth"):
        color_at_depth_size(np.zeros((*SIZE, 3), np.uint8), skewed, HALF_K, HALF)
