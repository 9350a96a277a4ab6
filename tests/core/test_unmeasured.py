from __future__ import annotations

import numpy as np
import pytest

from bask_data.core.fit import FacedSurface, sketch, sketch_rays
from bask_data.core.unmeasured import SketchedView, unmeasured_regions
from tests.meshes import sheet
from tests.scenes import Box, Plane, Scene, intrinsics, orbit

HEIGHT, WIDTH = 240, 320
K = intrinsics(HEIGHT, WIDTH)
BOUNDS = np.array([[-0.3, -0.3, -0.03], [0.3, 0.3, 0.1]])
TABLE = (Plane(extent=0.45),)
GLASS = Box((0.03, 0.04, 0.06), np.array([[1, 0, 0, 0.1], [0, 1, 0, -0.05], [0, 0, 1, 0.06], [0, 0, 0, 1.0]]))
CLAY = Box((0.03, 0.03, 0.03), np.array([[1, 0, 0, -0.12], [0, 1, 0, 0.1], [0, 0, 1, 0.03], [0, 0, 0, 1.0]]))


def views_of(cameras: np.ndarray, *, unseen: tuple[Box, ...] = (), missing: float = 0.0) -> list[SketchedView]:
    """What cameras above a table with a block on it see; they get no measurement where `unseen` bodies stand."""
    rng = np.random.default_rng(0)
    vertices, triangles = sheet((-0.3, -0.3, 0), (0.6, 0, 0), (0, 0.6, 0), 0.02)
    surface = FacedSurface(vertices.astype(np.float32), triangles.astype(np.int32))
    views = []
    for camera in cameras:
        depth = Scene((CLAY,), TABLE).render(K, camera, HEIGHT, WIDTH).depth
        hidden = Scene(unseen, TABLE).render(K, camera, HEIGHT, WIDTH).instance > 0
        depth = np.where(hidden | (rng.random(depth.shape) < missing), np.float32(0), depth)
        one = sketch(depth, depth, 4.0, n_columns=80)
        mesh_depth, _ = surface.cast(sketch_rays(one, K, camera))
        views.append(SketchedView(one, K, camera, mesh_depth.reshape(one.depth.shape)))
    return views


def test_what_no_camera_measured_is_found_where_it_stands() -> None:
    [region] = unmeasured_regions(views_of(orbit(24), unseen=(GLASS,)), BOUNDS)
    assert region.centre == pytest.approx((0.1, -0.05, 0.06), abs=0.02)
    assert region.size == pytest.approx((0.06, 0.08, 0.12), abs=0.05)
    assert 0.5 * 0.06 * 0.08 * 0.12 < region.volume < 3 * 0.06 * 0.08 * 0.12


def test_two_of_them_are_told_apart_and_the_larger_is_first() -> None:
    other = Box((0.025, 0.025, 0.04), np.array([[1, 0, 0, -0.1], [0, 1, 0, -0.12], [0, 0, 1, 0.04], [0, 0, 0, 1.0]]))
    first, second = unmeasured_regions(views_of(orbit(24), unseen=(GLASS, other)), BOUNDS)
    assert first.centre == pytest.approx((0.1, -0.05, 0.06), abs=0.02)
    assert second.centre == pytest.approx((-0.1, -0.12, 0.04), abs=0.02)


def test_what_was_measured_gives_no_alarm_even_with_holes_in_the_depth() -> None:
    assert unmeasured_regions(views_of(orbit(24)), BOUNDS) == []
    assert unmeasured_regions(views_of(orbit(24), missing=0.2), BOUNDS) == []


def test_views_from_one_side_do_not_tell_where_on_their_rays_it_stands() -> None:
    from_one_side = orbit(24, n_turns=0.12)
    assert unmeasured_regions(views_of(from_one_side, unseen=(GLASS,)), BOUNDS) == []


def test_an_empty_background_is_no_region() -> None:
    wide = np.array([[-0.8, -0.8, -0.03], [0.8, 0.8, 0.3]])
    assert unmeasured_regions(views_of(orbit(24)), wide) == []
    low = orbit(24, elevation_deg=(5.0, 25.0))
    assert unmeasured_regions(views_of(low), wide) == []


def test_what_stands_higher_than_anything_measured_is_found_whole() -> None:
    [region] = unmeasured_regions(
        views_of(orbit(24), unseen=(GLASS,)), np.array([[-0.3, -0.3, -0.03], [0.3, 0.3, 0.03]])
    )
    assert region.centre[2] + region.size[2] / 2 > 0.11


def test_without_views_there_is_nothing_to_find() -> None:
    assert unmeasured_regions([], BOUNDS) == []
    blind = [
        SketchedView(
            sketch(np.zeros((HEIGHT, WIDTH), np.float32), np.zeros((HEIGHT, WIDTH), np.float32), 4.0, 80),
            K,
            orbit(1)[0],
            np.full((60, 80), np.inf, np.float32),
        )
    ]
    assert unmeasured_regions(blind, BOUNDS) == []
