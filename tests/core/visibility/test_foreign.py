from __future__ import annotations

import cv2
import numpy as np
import pytest

from bask_data.core.visibility.foreign import _colour_off, _may_be_strange
from tests.scenes import Box, Scene
from tests.two_boxes import (
    BACK,
    CAMERA,
    FRONT,
    HEIGHT,
    NOT_MEASURED,
    SCENE,
    WIDTH,
    K,
    look,
    mesh_of,
)

PAINTED = np.repeat(np.array([[200, 60, 40], [40, 180, 70], [150, 140, 120]], np.uint8), [8, 8, 4], axis=0)
"""Colours of the vertices of `mesh_of` two boxes and the table."""


def finger_over_the_scene(openness: float) -> tuple[Scene, np.ndarray]:
    """The scene with two fingers that reach in from the left and the right of the view; what is theirs is 3 and 4."""
    x = 0.005 + 0.025 * openness
    fingers = tuple(
        Box((0.2, 0.02, 0.03), world_from_finger(side * (x + 0.2), -0.25, 0.1), (30, 30, 160)) for side in (-1, 1)
    )
    return Scene((FRONT, BACK, *fingers), SCENE.background), np.array([3, 4])


def world_from_finger(x: float, y: float, z: float) -> np.ndarray:
    world_from_box = np.eye(4)
    world_from_box[:3, 3] = x, y, z
    return world_from_box


@pytest.mark.parametrize("openness", [0.0, 0.4, 1.0])
@pytest.mark.parametrize("with_depth", [True, False])
def test_fingers_that_move_are_in_no_mask_with_depth_on_them_or_by_their_colour(
    openness: float, with_depth: bool
) -> None:
    scene, fingers = finger_over_the_scene(openness)
    view = scene.render(K, CAMERA, HEIGHT, WIDTH)
    on_finger = np.isin(view.instance, fingers)
    palette = np.array([[150, 140, 120], [200, 60, 40], [40, 180, 70], [30, 30, 160], [30, 30, 160]], np.uint8)
    rng = np.random.default_rng(0)
    # A third brighter than when the mesh was coloured: the camera's exposure is its own.
    rgb = np.clip(palette[view.instance] * 1.33 + rng.normal(scale=4, size=(HEIGHT, WIDTH, 3)), 0, 255).astype(np.uint8)
    depth = view.depth if with_depth else np.where(on_finger, np.float32(0), view.depth)
    boxes = mesh_of((FRONT, BACK), [1, 2], colors=PAINTED)
    by_ray = look(boxes, NOT_MEASURED).instance
    covered = on_finger & (by_ray > 0)
    assert covered.sum() > 100, "they cover the objects"
    frame = look(boxes, depth, rgb=rgb)
    assert (frame.instance[on_finger] > 0).sum() < 0.005 * (frame.instance > 0).sum()
    elsewhere = (view.instance > 0) & ~on_finger
    assert (frame.instance == view.instance)[elsewhere].mean() > 0.99
    if not with_depth:
        assert frame.n_pixels["hidden_by_colour"] > 100
        assert not frame.measured[covered].any()


@pytest.mark.parametrize("shape", [(1, 9), (9, 1), (2, 9), (9, 2), (1, 1), (3, 9), (9, 3), (12, 15)])
def test_the_quick_test_misses_no_pixel_of_an_image_of_any_size(shape: tuple[int, int]) -> None:
    rng, limit = np.random.default_rng(0), np.float32(1.0)
    for _ in range(50):
        off = np.where(rng.random(shape) < 0.5, 2 * rng.random(shape), 0).astype(np.float32)
        silent = rng.random(shape) < 0.5
        n_around = cv2.boxFilter((off > 0).astype(np.float32), -1, (5, 5), normalize=False)
        mean_off = cv2.boxFilter(off, -1, (5, 5), normalize=False) / np.maximum(n_around, 1)
        # In Python, which refuses an index outside the image; compiled, it reads other memory.
        quick = _may_be_strange.py_func(off, silent, np.float32(0.99) * limit)
        assert quick or not (silent & (mean_off > limit)).any()


def test_the_mark_of_no_vertex_is_not_compiled_in() -> None:
    i_vertex, rgb = np.array([[0, 1, 2]], np.int32), np.zeros((1, 3, 3), np.uint8)
    colors = np.full((3, 3), 9, np.uint8)
    for no_vertex in range(3):
        off = _colour_off(rgb, colors, i_vertex, np.ones((1, 3), bool), np.ones(3, np.float32), np.int32(no_vertex))
        np.testing.assert_array_equal(off, 9 * (i_vertex != no_vertex))


def test_a_highlight_without_depth_on_an_object_stays_in_its_mask() -> None:
    view = SCENE.render(K, CAMERA, HEIGHT, WIDTH)
    palette = np.array([[150, 140, 120], [200, 60, 40], [40, 180, 70]], np.uint8)
    rgb, depth = palette[view.instance], view.depth.copy()
    v, u = np.argwhere(view.instance == 1).mean(axis=0).astype(int)
    rgb[v - 6 : v + 7, u - 6 : u + 7], depth[v - 6 : v + 7, u - 6 : u + 7] = 255, 0
    frame = look(mesh_of((FRONT, BACK), [1, 2], colors=PAINTED), depth, rgb=rgb)
    assert (frame.instance != view.instance).sum() <= 2
    assert frame.n_pixels["hidden_by_colour"] == 0
