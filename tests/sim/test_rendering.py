from __future__ import annotations

import cv2
import numpy as np
import pytest

from bask_data.core.geometry import invert_rigid, pixel_grid, project, transform, unproject
from bask_data.sim import gripper
from bask_data.sim.options import TASKS, SimOptions, TaskName
from bask_data.sim.rendering import RenderedView, Renderer, intrinsics, metric
from bask_data.sim.scan import scan
from bask_data.sim.world import FAR, NEAR, TABLE, World
from tests.sim.worlds import (
    demonstration_of,
    distance_to_surface,
    first_hit,
    intrinsics_of,
    points_world,
    renderer_of,
    scan_of,
    views,
    world_of,
)

FACETS = 7e-4
"""Largest distance, metres, of the facets that approximate a round surface from it."""


def rays_world(view: RenderedView, K: np.ndarray) -> np.ndarray:
    """Rays in the world frame with length 1 along the camera's axis, so that z-depth scales them to surfaces."""
    height, width = view.depth.shape
    return unproject(pixel_grid(height, width), np.ones((height, width)), K) @ view.world_from_camera[:3, :3].T


def inner(instance: np.ndarray) -> np.ndarray:
    """Pixels whose neighbours show the same body."""
    kernel = np.ones((3, 3), dtype=np.uint8)
    return cv2.erode(instance, kernel) == cv2.dilate(instance, kernel)


@pytest.mark.parametrize("camera", ["wrist", "overhead"])
def test_depth_of_the_table_is_where_rays_meet_height_zero(camera: str) -> None:
    world, take = world_of("phone"), scan_of("phone")
    K = intrinsics_of(world, camera)
    for view in views(world, take, camera, [0, 2, 5]):
        eye, rays = view.world_from_camera[:3, 3], rays_world(view, K)
        with np.errstate(divide="ignore"):
            z_depth = -eye[2] / rays[..., 2]
        ground = eye + rays * z_depth[..., None]
        seen = (view.instance == 0) & (z_depth > 0) & (np.abs(ground[..., :2]) < np.array(TABLE)).all(axis=-1)
        assert seen.sum() > 1000
        assert np.abs(view.depth[seen] - z_depth[seen]).max() < 2e-5


@pytest.mark.parametrize("task", TASKS)
def test_depth_and_labels_agree_with_ray_casting(task: TaskName) -> None:
    world, take = world_of(task), demonstration_of(task)
    rng = np.random.default_rng(0)
    for camera in ("wrist", "overhead"):
        K = intrinsics_of(world, camera)
        [view] = views(world, take, camera, [len(take.time) // 2])
        eye, rays = view.world_from_camera[:3, 3], rays_world(view, K)
        errors, same = [], []
        for v, u in rng.permutation(np.argwhere(inner(view.instance)))[:300]:
            geom, z_depth = first_hit(world, eye, rays[v, u])
            same.append((world.geom_labels[geom] if geom >= 0 else 0) == view.instance[v, u])
            if geom >= 0 and z_depth < FAR:
                errors.append(abs(z_depth - view.depth[v, u]))
            else:
                assert view.depth[v, u] == 0
        assert np.mean(same) > 0.99
        # A ray along an inner edge of a body may pass on either side of it.
        assert np.quantile(errors, 0.98) < 2 * FACETS
        assert np.median(errors) < 1e-5


@pytest.mark.parametrize("task", TASKS)
def test_every_pixel_of_an_object_lies_on_its_surface_at_the_ground_truth_pose(task: TaskName) -> None:
    world, take = world_of(task), demonstration_of(task)
    first, last = take.world_from_objects[0], take.world_from_objects[-1]
    assert np.linalg.norm(first[:, :3] - last[:, :3], axis=(1, 2)).max() > 0.1
    for camera in ("wrist", "overhead"):
        K = intrinsics_of(world, camera)
        for i_frame in (0, len(take.time) - 1):
            [view] = views(world, take, camera, [i_frame])
            points = points_world(view, K)
            for i, label in enumerate(world.labels.values()):
                np.testing.assert_allclose(
                    world.world_from_objects()[i], take.world_from_objects[i_frame, i], atol=1e-9
                )
                seen = points[inner(view.instance) & (view.instance == label)]
                if len(seen):
                    geoms = np.flatnonzero(world.geom_labels == label)
                    away = np.min([distance_to_surface(world, geom, seen) for geom in geoms], axis=0)
                    assert away.max() < FACETS


def test_points_of_an_object_move_with_its_ground_truth_pose() -> None:
    world, take = world_of("phone"), demonstration_of("phone")
    label, K = world.labels["phone"], intrinsics_of(world, "overhead")
    row, last = label - 1, len(take.time) - 1
    before, after = views(world, take, "overhead", [0, last])
    moved = take.world_from_objects[last, row] @ invert_rigid(take.world_from_objects[0, row])
    points = transform(moved, points_world(before, K)[before.instance == label])
    uv, z = project(transform(invert_rigid(after.world_from_camera), points), K)
    u, v = np.rint(uv).astype(int).T
    visible = inner(after.instance)[v, u] & (after.instance[v, u] == label) & (np.abs(after.depth[v, u] - z) < 0.004)
    assert visible.mean() > 0.2
    # The same points have the same colour, except for the changed lighting.
    a = before.rgb[before.instance == label][visible].astype(float)
    b = after.rgb[v[visible], u[visible]].astype(float)
    assert np.corrcoef(a.ravel(), b.ravel())[0, 1] > 0.9


def test_glass_has_depth_and_label_and_is_transparent() -> None:
    world, take = world_of("lid"), scan_of("lid")
    [view] = views(world, take, "overhead", [0])
    assert (view.instance[view.is_glass] == world.labels["lid"]).all()
    assert view.is_glass.sum() > 100
    lid = world.world_from_body("lid")[2, 3]
    heights = points_world(view, intrinsics_of(world, "overhead"))[inner(np.uint8(view.is_glass)) & view.is_glass, 2]
    assert np.median(heights) == pytest.approx(lid + 0.008, abs=1e-4)


def test_only_the_lids_appearance_is_invariant_to_rotation() -> None:
    for task, name, symmetric in (("lid", "lid", True), ("rubbish", "can", False)):
        world, take = world_of(task), scan_of(task)  # type: ignore[arg-type]
        [before] = views(world, take, "overhead", [0])
        turned = take.qpos[0].copy()
        quat = slice(world.address(name) + 3, world.address(name) + 7)
        half = np.radians(60) / 2  # as many whole facets
        w, x, y, z = turned[quat]
        cosine, sine = np.cos(half), np.sin(half)
        turned[quat] = [w * cosine - z * sine, x * cosine + y * sine, y * cosine - x * sine, z * cosine + w * sine]
        world.show(turned)
        after = renderer_of(world).view("overhead")
        on_it = (before.instance == world.labels[name]) & (after.instance == world.labels[name])
        change = np.abs(before.rgb[on_it].astype(float) - after.rgb[on_it]).mean()
        assert (change < 3) == symmetric, (name, change)


def test_gripper_is_rendered_only_on_request() -> None:
    world, take = world_of("lid"), scan_of("lid")
    [hidden] = views(world, take, "wrist", [1], shows_gripper=False)
    [shown] = views(world, take, "wrist", [1], shows_gripper=True)
    on_gripper = shown.instance == gripper.LABEL
    assert 0.02 < on_gripper.mean() < 0.35
    assert (hidden.instance != gripper.LABEL).all()
    assert (shown.depth[on_gripper] < hidden.depth[on_gripper]).mean() > 0.99
    for name in ("rgb", "depth", "instance"):
        np.testing.assert_array_equal(getattr(shown, name)[~on_gripper], getattr(hidden, name)[~on_gripper])


def test_cameras_of_different_sizes_share_one_renderer() -> None:
    world = World(SimOptions(task="phone", frames=1, height=60, width=80, overhead_height=90, overhead_width=48))
    take = scan(world, np.random.default_rng(0))
    for camera, size in (("wrist", (60, 80)), ("overhead", (90, 48))):
        [view] = views(world, take, camera, [0])
        assert view.rgb.shape == (*size, 3)
        assert view.depth.shape == view.instance.shape == size
        K = intrinsics_of(world, camera)
        table = points_world(view, K)[(view.instance == 0) & (np.abs(points_world(view, K)[..., 2]) < 0.01)]
        assert np.abs(table[:, 2]).max() < 2e-5


def test_principal_point_is_the_centre_of_integer_pixels() -> None:
    K = intrinsics(90.0, 100, 60)
    np.testing.assert_allclose(K, [[50, 0, 29.5], [0, 50, 49.5], [0, 0, 1]])


def test_depth_of_the_near_plane_the_far_plane_and_between() -> None:
    mid = (1 / 0.5 - 1 / FAR) / (1 / NEAR - 1 / FAR)
    buffer = np.array([[1.0, mid, 0.0]], dtype=np.float32)
    np.testing.assert_allclose(metric(buffer), [[NEAR, 0.5, 0.0]], rtol=1e-6)


def test_rendering_is_deterministic() -> None:
    world, take = world_of("rubbish"), scan_of("rubbish")
    first, second = (views(world, take, "wrist", [3])[0] for _ in range(2))
    for name in ("rgb", "depth", "instance", "is_glass", "world_from_camera"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))


def test_objects_are_textured_and_differ_from_each_other() -> None:
    world, take = world_of("rubbish"), scan_of("rubbish")
    [view] = views(world, take, "overhead", [0])
    means = []
    for label in world.labels.values():
        pixels = view.rgb[view.instance == label].astype(float)
        assert pixels.std(axis=0).max() > 8
        means.append(pixels.mean(axis=0))
    apart = [np.linalg.norm(a - b) for i, a in enumerate(means) for b in means[:i]]
    assert min(apart) > 25


def test_every_geom_has_the_label_of_its_body() -> None:
    world = world_of("rubbish")
    bodies = [world.model.body(i).name for i in world.model.geom_bodyid]
    for name, label in zip(bodies, world.geom_labels, strict=True):
        expected = world.labels.get(name, 0 if name == "world" else gripper.LABEL)
        assert label == expected


def test_renderer_can_be_closed_and_another_opened() -> None:
    world = world_of("phone")
    for _ in range(3):
        with Renderer(world) as renderer:
            assert renderer.view("overhead").depth.max() > 0.5
