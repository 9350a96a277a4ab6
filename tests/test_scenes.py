"""The ray-caster is the truth of the other tests, so it is held against formulas itself."""

from __future__ import annotations

import numpy as np
import pytest

from bask_data.core.geometry import (
    invert_rigid,
    pixel_grid,
    project,
    rigid_fault,
    transform,
    unproject,
)
from tests.scenes import (
    Box,
    Plane,
    Scene,
    Sphere,
    intrinsics,
    look_at,
    noisy,
    orbit,
    tabletop,
)

HEIGHT, WIDTH = 61, 81
K = intrinsics(HEIGHT, WIDTH)


def test_centre_pixel_of_a_sphere_measures_its_nearest_point() -> None:
    scene = Scene((Sphere((0.0, 0.0, 0.0), 0.1),), background=())
    view = scene.render(K, look_at((0.0, -0.6, 0.0)), HEIGHT, WIDTH)
    assert view.depth[30, 40] == pytest.approx(0.5, abs=1e-6)
    assert view.instance[30, 40] == 1
    assert view.depth[0, 0] == 0
    assert view.instance[0, 0] == 0


def test_outline_of_a_sphere_has_the_radius_perspective_gives_it() -> None:
    distance, radius = 0.6, 0.1
    scene = Scene((Sphere((0.0, 0.0, 0.0), radius),), background=())
    view = scene.render(K, look_at((0.0, -distance, 0.0)), HEIGHT, WIDTH)
    radius_px = K[0, 0] * radius / np.sqrt(distance**2 - radius**2)
    from_middle = np.linalg.norm(pixel_grid(HEIGHT, WIDTH) - [40, 30], axis=-1)
    assert np.array_equal(view.instance == 1, from_middle <= radius_px)


def test_front_of_a_box_is_flat_in_z_depth_although_rays_to_its_rim_are_longer() -> None:
    scene = Scene((Box((0.2, 0.05, 0.1)),), background=())
    view = scene.render(K, look_at((0.0, -0.55, 0.0)), HEIGHT, WIDTH)
    assert np.allclose(view.depth[view.instance == 1], 0.5, atol=1e-6)
    assert (view.instance == 1).sum() > 100


def test_every_measured_pixel_lifts_to_the_surface_of_its_own_body() -> None:
    scene = tabletop(5, seed=3)
    for world_from_camera in orbit(4):
        view = scene.render(K, world_from_camera, HEIGHT, WIDTH)
        seen = view.depth > 0
        points = unproject(pixel_grid(HEIGHT, WIDTH)[seen], view.depth[seen].astype(float), K)
        points_world = transform(world_from_camera, points)
        assert scene.surface_distance(points_world).max() < 1e-6
        on_object = view.instance[seen] > 0
        assert np.array_equal(scene.instance_at(points_world)[on_object], view.instance[seen][on_object])


def test_a_body_in_front_hides_the_one_behind_but_not_its_amodal_mask() -> None:
    scene = Scene((Sphere((0.0, 0.0, 0.0), 0.05), Sphere((0.0, -0.2, 0.0), 0.1)), background=())
    camera = look_at((0.0, -0.8, 0.0))
    view = scene.render(K, camera, HEIGHT, WIDTH)
    amodal = scene.amodal(K, camera, HEIGHT, WIDTH)
    assert not (view.instance == 1).any()
    assert amodal[0].sum() > 10
    assert np.array_equal(amodal[1], view.instance == 2)


def test_look_at_puts_the_target_in_the_middle_with_the_world_upright() -> None:
    camera = look_at((0.4, -0.5, 0.3), (0.0, 0.1, 0.05))
    assert rigid_fault(camera) == ""
    points_world = np.array([[0.0, 0.1, 0.05], [0.0, 0.1, 0.06]])
    uv, _ = project(transform(invert_rigid(camera), points_world), K)
    assert np.allclose(uv[0], [40, 30])
    assert uv[1, 1] < uv[0, 1], "a higher point has the smaller v"
    assert rigid_fault(look_at((0.0, 0.0, 1.0))) == "", "straight down is a direction like any other"


def test_orbit_stays_on_the_hemisphere_and_sees_the_middle_of_the_table() -> None:
    cameras = orbit(12, radius=0.7)
    assert cameras.shape == (12, 4, 4)
    assert np.allclose(np.linalg.norm(cameras[:, :3, 3] - [0, 0, 0.03], axis=1), 0.7)
    assert (cameras[:, 2, 3] > 0.2).all()
    assert all(rigid_fault(camera) == "" for camera in cameras)


def test_tabletop_objects_do_not_touch_and_stand_on_the_table() -> None:
    scene = tabletop(6, seed=1)
    assert repr(scene) == repr(tabletop(6, seed=1))
    assert repr(scene) != repr(tabletop(6, seed=2))
    view = Scene(scene.objects, background=()).amodal(intrinsics(200, 200, 90), look_at((0, 0, 0.6)), 200, 200)
    assert view.sum(axis=0).max() == 1, "seen from above, no two objects overlap"
    for body in scene.objects:
        lowest = 0.0 if isinstance(body, Sphere) else body.world_from_box[2, 3] - body.half[2]
        assert lowest == pytest.approx(0.0, abs=1e-12)


def test_distance_to_a_box_is_exact_inside_and_out() -> None:
    box = Box((0.1, 0.2, 0.3), look_at((1.0, 2.0, 3.0)))
    local = np.array([[0, 0, 0], [0.15, 0, 0], [0.1, 0.2, 0.3], [0.13, 0.24, 0.3]])
    assert np.allclose(box.distance(transform(box.world_from_box, local)), [0.1, 0.05, 0.0, 0.05])


def test_a_plane_with_an_extent_is_a_disc() -> None:
    plane = Plane(extent=0.1)
    assert np.allclose(plane.distance(np.array([[0, 0, 0.2], [0.4, 0, 0.4]])), [0.2, 0.5])
    view = Scene((), (plane,)).render(K, look_at((0, 0, 0.5)), HEIGHT, WIDTH)
    assert view.depth[30, 40] == pytest.approx(0.5)
    assert view.depth[0, 0] == 0


def test_noise_has_the_spread_asked_for_and_leaves_missing_depth_missing() -> None:
    depth = np.full((100, 100), 0.5, np.float32)
    depth[:10] = 0
    measured = noisy(depth, 0.002, np.random.default_rng(0), share_missing=0.3)
    assert (measured[:10] == 0).all()
    assert (measured[10:] == 0).mean() == pytest.approx(0.3, abs=0.03)
    assert (measured[measured > 0] - 0.5).std() == pytest.approx(0.002, rel=0.05)
    assert np.array_equal(measured, noisy(depth, 0.002, np.random.default_rng(0), share_missing=0.3))


def test_texture_moves_with_the_body() -> None:
    camera = look_at((0.0, -0.5, 0.2))
    shift = np.eye(4)
    shift[:3, 3] = [0.3, 0.2, 0.1]
    box = Box((0.05, 0.05, 0.05))
    here = Scene((box,), ()).render(K, camera, HEIGHT, WIDTH)
    there = Scene((Box(box.half, shift),), ()).render(K, shift @ camera, HEIGHT, WIDTH)
    assert np.abs(here.rgb.astype(int) - there.rgb).max() <= 1
    assert here.rgb[here.instance == 1].std() > 10
