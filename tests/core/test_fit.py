from __future__ import annotations

import numpy as np
import pytest

from bask_data.core.fit import FacedSurface, Sketch, fit, outliers, sketch, sketch_rays
from tests.meshes import sheet
from tests.scenes import Plane, Scene, intrinsics, look_at

HEIGHT, WIDTH = 240, 320
K = intrinsics(HEIGHT, WIDTH)
ABOVE = look_at((0.0, 0.0, 0.6))
BOUNDS = np.array([[-0.2, -0.2, -0.05], [0.2, 0.2, 0.2]])
TABLE = Scene((), (Plane(),))


def table_mesh(height: float = 0.0) -> FacedSurface:
    vertices, triangles = sheet((-0.2, -0.2, height), (0.4, 0, 0), (0, 0.4, 0), 0.02)
    return FacedSurface(vertices.astype(np.float32), triangles.astype(np.int32))


def seen(scene: Scene, camera: np.ndarray = ABOVE) -> Sketch:
    depth = scene.render(K, camera, HEIGHT, WIDTH).depth
    return sketch(depth, depth, 4.0)


def test_a_sketch_holds_the_middle_pixel_of_each_block_and_the_share_measured() -> None:
    raw = np.arange(1, 16 * 80 + 1, dtype=np.float32).reshape(16, 80) / 1000
    raw[0:2, 0:2] = 0
    raw[0, 2] = 0
    one = sketch(raw, raw, 4.0, n_columns=40)
    assert one.step == 2
    assert np.array_equal(one.depth, np.where(raw[1::2, 1::2] > 0, raw[1::2, 1::2], 0))
    assert one.measured[0, :3].tolist() == [0, 191, 255]


def test_a_sketch_keeps_what_lies_beyond_the_range_but_not_what_cleaning_dropped() -> None:
    raw = np.full((4, 4), 1.0, np.float32)
    raw[1, 1], raw[1, 3] = 5.0, 2.0
    cleaned = np.where(raw == 1.0, raw, np.float32(0))
    one = sketch(raw, cleaned, 4.0, n_columns=2)
    assert one.depth.tolist() == [[5.0, 0.0], [1.0, 1.0]]


def test_rays_of_a_sketch_lead_to_the_points_it_measured() -> None:
    camera = look_at((0.3, -0.4, 0.5))
    one = seen(TABLE, camera)
    rays = sketch_rays(one, K, camera)
    points = rays[:, :3] + one.depth.reshape(-1, 1) * rays[:, 3:]
    assert np.abs(points[:, 2]).max() < 1e-6


def test_a_mesh_on_the_measured_surface_explains_it_all() -> None:
    one = fit(seen(TABLE), K, ABOVE, table_mesh(), BOUNDS)
    assert one.n_judged > 300
    assert one.explained == 1.0
    assert one.residual_abs < 1e-6
    assert one.from_behind == 0.0


def test_a_mesh_too_high_explains_nothing_and_the_residual_says_by_how_much() -> None:
    one = fit(seen(TABLE), K, ABOVE, table_mesh(0.05), BOUNDS)
    assert one.explained == 0.0
    assert one.residual == pytest.approx(0.05, abs=1e-5)
    assert one.residual_abs == pytest.approx(0.05, abs=1e-5)
    low = fit(seen(TABLE), K, ABOVE, table_mesh(-0.04), BOUNDS)
    assert low.residual == pytest.approx(-0.04, abs=1e-5)


def test_what_was_measured_outside_the_workspace_counts_only_behind_the_mesh() -> None:
    shallow = np.array([[-0.2, -0.2, 0.05], [0.2, 0.2, 0.2]])
    assert fit(seen(TABLE), K, ABOVE, table_mesh(0.1), shallow).n_judged > 300, "seen through the mesh"
    assert fit(seen(TABLE), K, ABOVE, table_mesh(-0.1), shallow).n_judged == 0, "seen before the mesh"
    blind = np.zeros((HEIGHT, WIDTH), np.float32)
    nothing = fit(sketch(blind, blind, 4.0), K, ABOVE, table_mesh(), BOUNDS)
    assert nothing.n_judged == 0
    assert np.isnan([nothing.explained, nothing.residual, nothing.residual_abs]).all()


def test_a_surface_seen_from_its_back_is_told_from_one_seen_from_its_front() -> None:
    below = look_at((0.0, 0.0, -0.6))
    surface = table_mesh()
    assert fit(seen(TABLE, below), K, below, surface, BOUNDS).from_behind == 1.0
    assert surface.area_from_behind == 1.0
    fit(seen(TABLE), K, ABOVE, surface, BOUNDS)
    assert surface.area_from_behind < 0.2, "a front seen once is a front"
    assert table_mesh().area_from_behind == 0.0


def judged(share: np.ndarray, error: np.ndarray | None = None) -> list[int]:
    error = np.full(len(share), 0.002) if error is None else error
    return np.flatnonzero(outliers(np.full(len(share), 1000), share, error)).tolist()


def test_a_frame_that_the_mesh_does_not_explain_stands_out() -> None:
    share = 0.9 + 0.02 * np.sin(np.arange(20))
    assert judged(share) == []
    share[7] = 0.3
    assert judged(share) == [7]
    error = np.full(20, 0.002)
    error[3] = 0.02
    assert judged(0.9 + 0.02 * np.sin(np.arange(20)), error) == [3]


def test_a_frame_is_held_against_those_around_it_when_all_of_them_change() -> None:
    share = np.linspace(0.95, 0.6, 60) + 0.005 * np.sin(np.arange(60))
    assert judged(share) == [], "a slow change is the scene's"
    share[30] -= 0.15
    assert judged(share) == [], "a view along the surface"
    error = np.full(60, 0.002)
    error[30] = 0.003
    assert np.flatnonzero(outliers(np.full(60, 1000), share, error)).tolist() == [30]
    share[30] -= 0.1
    assert judged(share) == [30]


def test_few_or_hardly_judged_frames_tell_nothing() -> None:
    share, error = np.array([0.9, 0.9, 0.1, 0.9]), np.full(4, 0.002)
    assert not outliers(np.full(4, 1000), share, error).any()
    share, error = np.array([0.9] * 9 + [0.1]), np.full(10, 0.002)
    assert outliers(np.full(10, 1000), share, error).tolist() == [False] * 9 + [True]
    assert not outliers(np.array([1000] * 9 + [10]), share, error).any()
    share[9] = np.nan
    assert not outliers(np.full(10, 1000), share, error).any()
