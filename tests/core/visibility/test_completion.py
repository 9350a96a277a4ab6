"""Holes of a mesh are filled where nothing was measured through them, and nowhere else."""

from __future__ import annotations

import numpy as np
import pytest

from bask_data.core.visibility.completion import Completion
from bask_data.core.visibility.labelled import LabelledSurface
from bask_data.core.visibility.surface import ray_directions, rays_of
from bask_data.core.visibility.visible import MeasuredFrame, visible_instances
from tests.meshes import block, joined, sheet
from tests.scenes import Box, Plane, Scene, View, intrinsics, look_at, orbit

HEIGHT, WIDTH = 120, 160
K = intrinsics(HEIGHT, WIDTH)
DIRECTIONS = ray_directions(K, HEIGHT, WIDTH)
TOLERANCE = (0.008, 0.0)
CAMERA = look_at((0.05, -0.45, 0.3), (0.0, 0.0, 0.05))


def at(x: float, y: float, z: float, half: tuple[float, float, float]) -> Box:
    world_from_box = np.eye(4)
    world_from_box[:3, 3] = x, y, z
    return Box(half, world_from_box)


BOX = at(0.0, 0.0, 0.06, (0.06, 0.06, 0.06))
TABLE = Plane(extent=0.5)
SOLID = Scene((BOX,), (TABLE,))
BARS = tuple(at(x, 0.0, z, (w, 0.015, h)) for x, z, w, h in ((-0.05, 0.06, 0.01, 0.06), (0.05, 0.06, 0.01, 0.06)))
FRAME = Scene((*BARS, at(0.0, 0.0, 0.11, (0.06, 0.015, 0.01))), (TABLE,))
"""Like the handle of a mug: the table is seen through it."""


def with_table(parts: list, labels: list[int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    vertices, triangles, source = joined([*parts, sheet((-0.4, -0.4, 0), (0.8, 0, 0), (0, 0.8, 0), 0.02)])
    return vertices, triangles, np.array([*labels, 0], np.int32)[source]


def box_with_a_hole() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The mesh of `BOX` without the middle of its front."""
    vertices, triangles = block(-0.06, -0.06, (0.12, 0.12, 0.12), 0.01)
    middle = vertices[triangles].mean(axis=1)
    hole = (middle[:, 1] < -0.055) & (np.abs(middle[:, 0]) < 0.035) & (np.abs(middle[:, 2] - 0.06) < 0.035)
    return with_table([(vertices, triangles[~hole])], [1])


def handle() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    bars = [
        block(x - w, -0.015, (2 * w, 0.03, 2 * h), 0.005, bottom=z - h)
        for x, z, w, h in ((-0.05, 0.06, 0.01, 0.06), (0.05, 0.06, 0.01, 0.06), (0.0, 0.11, 0.06, 0.01))
    ]
    return with_table(bars, [1, 1, 1])


def silent_hole(view: View) -> np.ndarray:
    """The view's depth, with nothing on the front of the box: a sheen."""
    v, u = np.nonzero(view.instance > 0)
    depth = view.depth.copy()
    points_on_front = (view.instance > 0) & (np.abs(view.depth - np.median(view.depth[v, u])) < 0.03)
    depth[points_on_front] = 0
    return depth


def carved(vertices: np.ndarray, labels: np.ndarray, depths: list[np.ndarray], cameras: np.ndarray) -> Completion:
    completion = Completion(vertices, labels, reach=0.004)
    for depth, camera in zip(depths, cameras, strict=True):
        completion.carve(depth, K, camera, TOLERANCE)
    completion.finish()
    return completion


CAMERAS = orbit(10, radius=0.5, elevation_deg=(20.0, 50.0))


def test_a_hole_nothing_was_measured_through_is_filled_and_marked() -> None:
    vertices, triangles, labels = box_with_a_hole()
    surface = LabelledSurface(vertices, triangles, labels, 1)
    views = [SOLID.render(K, camera, HEIGHT, WIDTH) for camera in CAMERAS]
    depths = [silent_hole(view) for view in views]
    completion = carved(vertices, labels, depths, CAMERAS)
    view = SOLID.render(K, CAMERA, HEIGHT, WIDTH)
    depth = np.where(view.instance > 0, np.float32(0), view.depth)
    bare = visible_instances(surface, MeasuredFrame(depth, DIRECTIONS, K, CAMERA), TOLERANCE)
    full = visible_instances(surface, MeasuredFrame(depth, DIRECTIONS, K, CAMERA), TOLERANCE, completion=completion)
    assert (bare.instance[view.instance == 1] == 0).mean() > 0.05, "the mesh has a hole"
    assert (full.instance[view.instance == 1] == 1).mean() > 0.995
    assert np.array_equal(full.instance[view.instance == 0], bare.instance[view.instance == 0])
    assert not full.measured[view.instance == 1].any()
    assert full.n_pixels["not_measured_and_filled"] > 50


def test_depth_measured_in_a_hole_of_the_mesh_is_the_objects() -> None:
    vertices, triangles, labels = box_with_a_hole()
    completion = carved(vertices, labels, [], CAMERAS[:0])
    view = SOLID.render(K, CAMERA, HEIGHT, WIDTH)
    frame = visible_instances(
        LabelledSurface(vertices, triangles, labels, 1),
        MeasuredFrame(view.depth, DIRECTIONS, K, CAMERA),
        TOLERANCE,
        completion=completion,
    )
    assert (frame.instance[view.instance == 1] == 1).mean() > 0.995
    assert frame.measured.all()
    assert frame.n_pixels["measured_where_the_mesh_has_a_hole"] > 50


@pytest.mark.parametrize("measured_here", [True, False])
def test_the_hole_of_a_handle_stays_open_where_the_table_was_measured_through_it(measured_here: bool) -> None:
    vertices, triangles, labels = handle()
    views = [FRAME.render(K, camera, HEIGHT, WIDTH) for camera in CAMERAS]
    completion = carved(vertices, labels, [view.depth for view in views], CAMERAS)
    surface = LabelledSurface(vertices, triangles, labels, 1)
    view = FRAME.render(K, CAMERA, HEIGHT, WIDTH)
    depth = view.depth if measured_here else np.zeros_like(view.depth)
    bare = visible_instances(surface, MeasuredFrame(depth, DIRECTIONS, K, CAMERA), TOLERANCE)
    full = visible_instances(surface, MeasuredFrame(depth, DIRECTIONS, K, CAMERA), TOLERANCE, completion=completion)
    changed = bare.instance != full.instance
    # Within the tolerance of bars and table nothing tells air from surface: a rim may be filled without measurement.
    middle = Scene((at(0.0, 0.0, 0.055, (0.028, 0.001, 0.03)),), ()).render(K, CAMERA, HEIGHT, WIDTH).instance > 0
    assert (middle & (view.instance == 0)).sum() > 150
    assert not changed[middle].any()
    if measured_here:
        assert not changed.any()


def test_what_no_frame_looked_through_is_solid() -> None:
    vertices, _, labels = handle()
    completion = carved(vertices, labels, [], CAMERAS[:0])
    rays = rays_of(DIRECTIONS, CAMERA).through(np.ones((HEIGHT, WIDTH), bool))
    z, label = completion.hit(rays)
    hull = Scene((at(0.0, 0.0, 0.06, (0.06, 0.015, 0.06)),), ()).render(K, CAMERA, HEIGHT, WIDTH)
    expected = hull.instance.reshape(-1)
    assert not label[expected == 0].any()
    # A cell is left out all around.
    assert (label == 1).sum() > 0.85 * expected.sum()
    both = (label == 1) & (expected == 1)
    assert np.median(np.abs(z[both] - hull.depth.reshape(-1)[both])) < 0.006


def test_the_air_between_objects_that_were_not_told_apart_is_left_alone() -> None:
    boxes = [block(x, y, (0.06, 0.06, 0.1), 0.01) for x, y in ((-0.12, -0.12), (0.06, -0.12), (-0.03, -0.03), (0, 0.1))]
    vertices, _, labels = with_table(boxes, [1, 1, 1, 1])
    completion = carved(vertices, labels, [], CAMERAS[:0])
    assert completion.holds(np.array([[0.0, -0.09, 0.05]], np.float32)).tolist() == [0]
    vertices, _, labels = with_table(boxes, [1, 2, 3, 4])
    completion = carved(vertices, labels, [], CAMERAS[:0])
    assert completion.holds(np.array([[0.0, -0.09, 0.05], [0.0, 0.0, 0.05]], np.float32)).tolist() == [0, 3]


def test_points_belong_to_the_hull_that_holds_them() -> None:
    vertices, _, labels = box_with_a_hole()
    completion = carved(vertices, labels, [], CAMERAS[:0])
    points = np.array([[0, -0.06, 0.06], [0, 0, 0.06], [0, -0.08, 0.06], [0, 0, 0.2], [9, 9, 9]], np.float32)
    assert completion.holds(points).tolist() == [1, 1, 0, 0, 0]


def test_flat_or_few_points_enclose_nothing() -> None:
    for points in (np.zeros((0, 3)), np.eye(3), np.random.default_rng(0).random((50, 3)) * [1, 1, 0]):
        completion = Completion(points.astype(np.float32), np.ones(len(points), np.int32), reach=0.004)
        completion.finish()
        assert completion.holds(np.zeros((2, 3), np.float32)).tolist() == [0, 0]
        z, label = completion.hit(np.array([[0, 0, 1, 0, 0, -1]], np.float32))
        assert np.isinf(z).all()
        assert label.tolist() == [0]
