from __future__ import annotations

import numpy as np
import pytest

from bask_data.core.geometry import invert_rigid, project, transform, unproject
from bask_data.core.local_warp import image_warp, surface_tangents, turn_of, visible_share
from tests import scenes

HEIGHT, WIDTH = 96, 128
K = scenes.intrinsics(HEIGHT, WIDTH)
TABLE = scenes.Plane()


def rolled(world_from_camera: np.ndarray, angle: float) -> np.ndarray:
    """The camera turned about its own axis."""
    roll = np.eye(4)
    roll[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    return world_from_camera @ roll


def on_the_table(uv: np.ndarray, world_from_camera: np.ndarray) -> np.ndarray:
    """The exact points of the table at pixels, world frame."""
    directions = unproject(uv, np.ones(len(uv)), K) @ world_from_camera[:3, :3].T
    z = TABLE.cast(world_from_camera[:3, 3], directions)
    return world_from_camera[:3, 3] + z[:, None] * directions


def warp_of(uv: np.ndarray, a: np.ndarray, b: np.ndarray, scene: scenes.Scene) -> np.ndarray:
    view = scene.render(K, a, HEIGHT, WIDTH)
    points, tangents = surface_tangents(uv, view.depth, view.instance, K)
    b_from_a = invert_rigid(b) @ a
    return image_warp(transform(b_from_a, points), b_from_a[:3, :3] @ tangents, K)


@pytest.mark.parametrize("roll", [0.0, 0.6, 2.5])
def test_the_warp_of_a_slanted_plane_is_the_derivative_of_the_way_of_its_pixels(roll: float) -> None:
    a, b = scenes.look_at((0.5, 0.1, 0.6)), rolled(scenes.look_at((-0.3, 0.4, 0.5)), roll)
    uv = np.random.default_rng(0).uniform(10, [WIDTH - 10, HEIGHT - 10], (50, 2))
    found = warp_of(uv, a, b, scenes.Scene((), (TABLE,)))
    for axis in range(2):
        step = np.eye(2)[axis] * 1e-4
        ends = [project(transform(invert_rigid(b), on_the_table(uv + sign * step, a)), K)[0] for sign in (-1.0, 1.0)]
        np.testing.assert_allclose(found[:, :, axis], (ends[1] - ends[0]) / 2e-4, rtol=2e-3, atol=2e-3)


@pytest.mark.parametrize("angle", [0.0, 0.3, 1.5, 3.0, -2.0])
def test_a_camera_that_rolls_turns_the_image_by_as_much(angle: float) -> None:
    a = scenes.look_at((0.3, 0.1, 0.6))
    found = warp_of(np.array([[60.0, 40.0], [30.2, 70.7]]), a, rolled(a, angle), scenes.Scene((), (TABLE,)))
    np.testing.assert_allclose(turn_of(found), abs(angle), atol=1e-5)
    np.testing.assert_allclose(np.linalg.det(found), 1.0, atol=1e-4)


def test_a_camera_half_as_far_above_sees_twice_as_large() -> None:
    a, b = scenes.look_at((0.0, 0.0, 0.8)), scenes.look_at((0.0, 0.0, 0.4))
    found = warp_of(np.array([[63.5, 47.5]]), a, b, scenes.Scene((), (TABLE,)))
    np.testing.assert_allclose(found[0], 2 * np.eye(2), atol=1e-3)


def test_around_a_table_what_lies_on_it_turns_by_more_than_what_stands_on_it() -> None:
    body = np.eye(4)
    body[2, 3] = 0.1
    scene = scenes.Scene((scenes.Box((0.1, 0.1, 0.1), body),))
    # A quarter of the way around: the top turns, and the edge between two sides still stands upright.
    a, b = scenes.look_at((0.5, -0.3, 0.5)), scenes.look_at((0.5, 0.3, 0.5))
    sides = project(transform(invert_rigid(a), np.array([[0.0, 0.0, 0.2], [0.1, 0.0, 0.1]])), K)[0]
    top, side = np.degrees(turn_of(warp_of(sides, a, b, scene)))
    assert top > 35
    assert side < 20


def test_other_bodies_in_the_window_do_not_bend_the_surface() -> None:
    a, b = scenes.look_at((0.5, 0.1, 0.6)), scenes.look_at((-0.3, 0.4, 0.5))
    scene = scenes.Scene((scenes.Sphere((0.0, 0.0, 0.1), 0.08),), (TABLE,))
    view = scene.render(K, a, HEIGHT, WIDTH)
    edge = (view.instance == 0) & (np.roll(view.instance, 1, axis=1) == 1)
    v, u = np.nonzero(edge)
    uv = np.stack([u, v], axis=1).astype(float)
    np.testing.assert_allclose(
        warp_of(uv, a, b, scene), warp_of(uv, a, b, scenes.Scene((), (TABLE,))), rtol=0.02, atol=0.02
    )


def test_a_lone_pixel_is_a_surface_that_faces_the_camera() -> None:
    depth, labels = np.zeros((9, 9), np.float32), np.zeros((9, 9), np.uint8)
    depth[4, 4] = 0.5
    points, tangents = surface_tangents(np.array([[4.0, 4.0]]), depth, labels, scenes.intrinsics(9, 9))
    np.testing.assert_allclose(points, [[0, 0, 0.5]], atol=1e-12)
    np.testing.assert_allclose(tangents[0, 2], 0, atol=1e-9)


def test_there_is_no_surface_without_depth_or_outside_the_image() -> None:
    depth, labels = np.zeros((9, 9), np.float32), np.zeros((9, 9), np.uint8)
    depth[:, :4] = 0.5
    points, tangents = surface_tangents(np.array([[7.0, 4.0], [-3.0, 4.0], [2.0, 2.0]]), depth, labels, K)
    assert np.isnan(points[:2]).all() and np.isnan(tangents[:2]).all()
    assert np.isfinite(points[2]).all() and np.isfinite(tangents[2]).all()


def test_the_visible_share_is_that_of_the_pixels_the_object_would_cover_alone() -> None:
    scene = scenes.Scene(
        (
            scenes.Sphere((0.0, 0.0, 0.0), 0.1),
            scenes.Sphere((0.14, 0.1, 0.05), 0.07),
            scenes.Sphere((0.1, -0.2, 0.0), 0.05),
        ),
        (),
    )
    cameras = scenes.orbit(20, radius=0.6, elevation_deg=(-40.0, 70.0))
    views = [scene.render(K, camera, HEIGHT, WIDTH) for camera in cameras]
    errors, shares = [], []
    for label in (1, 2, 3):
        surface = np.concatenate(
            [
                transform(
                    camera, unproject(np.argwhere(mine)[:, ::-1].astype(float), view.depth[mine].astype(float), K)
                )
                for camera, view in zip(cameras, views, strict=True)
                for mine in [view.instance == label]
            ]
        )
        for camera, view in zip(cameras, views, strict=True):
            alone = scene.amodal(K, camera, HEIGHT, WIDTH)[label - 1]
            shares.append((view.instance == label).sum() / alone.sum())
            errors.append(visible_share(surface, label, view.depth, view.instance, K, camera) - shares[-1])
    assert min(shares) < 0.7
    assert np.abs(errors).max() < 0.05


def test_what_is_not_in_the_image_has_no_visible_share() -> None:
    depth, labels = np.ones((9, 9), np.float32), np.zeros((9, 9), np.uint8)
    assert np.isnan(visible_share(np.array([[0.0, 0.0, -1.0]]), 1, depth, labels, K, np.eye(4)))
    assert visible_share(np.zeros((0, 3)), 1, depth, labels + np.uint8(1), K, np.eye(4)) == 1.0
