from __future__ import annotations

import cv2
import numpy as np
import pytest

from bask_data.core.depth import cleaned
from bask_data.core.tsdf import Volume
from bask_data.core.visibility.labelled import LabelledSurface
from bask_data.core.visibility.surface import ray_directions
from bask_data.core.visibility.visible import MeasuredFrame, visible_instances
from tests.scenes import Box, Scene, Sphere, intrinsics, look_at, noisy, orbit, tabletop
from tests.two_boxes import (
    BACK,
    CAMERA,
    DIRECTIONS,
    FRONT,
    HEIGHT,
    NOT_MEASURED,
    SCENE,
    TOLERANCE,
    WIDTH,
    K,
    box_at,
    look,
    mesh_of,
)


@pytest.mark.parametrize(
    "camera", [CAMERA, look_at((0.3, 0.4, 0.5)), look_at((0.01, 0.02, 0.8)), look_at((-0.5, 0.1, 0.1))]
)
def test_exact_mesh_gives_the_exact_mask_with_and_without_depth(camera: np.ndarray) -> None:
    # Half a pixel of shift in the rays alone would fail this.
    view = SCENE.render(K, camera, HEIGHT, WIDTH)
    surface = mesh_of((FRONT, BACK), [1, 2])
    for depth in (view.depth, NOT_MEASURED):
        assert (look(surface, depth, camera).instance != view.instance).sum() <= 2


def test_visible_fraction_is_that_of_the_analytic_scene() -> None:
    view = SCENE.render(K, CAMERA, HEIGHT, WIDTH)
    amodal = SCENE.amodal(K, CAMERA, HEIGHT, WIDTH)
    expected = [(view.instance == label).sum() / amodal[label - 1].sum() for label in (1, 2)]
    assert expected[1] < 0.9, "the scene hides a part of the back box"
    assert np.allclose(look(mesh_of((FRONT, BACK), [1, 2]), view.depth).visible_fraction, expected, atol=0.005)


def test_an_object_out_of_view_has_no_fraction_and_one_hidden_entirely_has_zero() -> None:
    hidden = box_at(0.0, 0.02, (0.01, 0.01, 0.01))
    far_off = box_at(5.0, -5.0)
    frame = look(mesh_of((FRONT, hidden, far_off), [1, 2, 3]), NOT_MEASURED, look_at((0.0, -0.7, 0.04)))
    assert frame.visible_fraction[0] == 1.0
    assert frame.visible_fraction[1] == 0.0
    assert np.isnan(frame.visible_fraction[2])


def test_an_object_beside_or_around_the_camera_does_no_harm() -> None:
    for camera in (look_at((0.0, -0.1, 0.04), (0.0, 1.0, 0.04)), look_at((0.0, -0.16, 0.04), (1.0, -0.16, 0.04))):
        depth = SCENE.render(K, camera, HEIGHT, WIDTH)
        frame = look(mesh_of((FRONT, BACK), [1, 2]), NOT_MEASURED, camera)
        assert np.array_equal(frame.instance, depth.instance)


def test_a_hand_the_mesh_does_not_know_is_in_no_mask() -> None:
    hand = Sphere((0.03, -0.25, 0.12), 0.03)
    view = Scene((*SCENE.objects, hand), SCENE.background).render(K, CAMERA, HEIGHT, WIDTH)
    surface = mesh_of((FRONT, BACK), [1, 2])
    frame = look(surface, view.depth)
    assert (view.instance == 3).sum() > 100
    assert (look(surface, NOT_MEASURED).instance[view.instance == 3] > 0).any(), "it covers a part of an object"
    assert (frame.instance[view.instance == 3] == 0).all()
    elsewhere = view.instance < 3
    assert (frame.instance[elsewhere] != view.instance[elsewhere]).sum() <= 2
    assert frame.n_pixels["measured_in_front"] > 100


def test_holes_in_the_depth_of_a_hand_stay_out_of_the_mask() -> None:
    hand = Sphere((0.03, -0.25, 0.12), 0.03)
    view = Scene((*SCENE.objects, hand), SCENE.background).render(K, CAMERA, HEIGHT, WIDTH)
    rng = np.random.default_rng(0)
    sparse = np.where(rng.random((HEIGHT, WIDTH)) < 0.3, view.depth, np.float32(0))
    instance = look(mesh_of((FRONT, BACK), [1, 2]), sparse).instance
    on_hand = view.instance == 3
    inside = cv2.erode(on_hand.astype(np.uint8), np.ones((7, 7), np.uint8)) > 0
    covering = on_hand & (SCENE.render(K, CAMERA, HEIGHT, WIDTH).instance > 0)
    assert (instance[covering] > 0).mean() < 0.15, "what is left is the rim"
    assert (instance[inside & covering] > 0).mean() < 0.01
    elsewhere = (view.instance > 0) & ~on_hand
    assert (instance[elsewhere] == view.instance[elsewhere]).mean() > 0.97


def test_an_object_taken_away_is_in_no_mask() -> None:
    view = Scene((BACK,), SCENE.background).render(K, CAMERA, HEIGHT, WIDTH)
    frame = look(mesh_of((FRONT, BACK), [1, 2]), view.depth)
    # At the foot the table behind the box is within the tolerance of the box.
    assert (frame.instance == 1).sum() < 0.2 * (SCENE.render(K, CAMERA, HEIGHT, WIDTH).instance == 1).sum()
    assert frame.n_pixels["measured_through"] > 100
    nothing_known_behind = look(mesh_of((FRONT, BACK), [1, 2], with_table=False), view.depth)
    assert (nothing_known_behind.instance == 1).sum() < 0.2 * (frame.measured & (view.instance == 0)).sum()
    assert nothing_known_behind.n_pixels["measured_behind"] > 100


def test_edges_lie_where_they_were_measured_and_not_where_the_mesh_has_them() -> None:
    view = SCENE.render(K, CAMERA, HEIGHT, WIDTH)
    for grown in (0.003, -0.003):
        bodies = tuple(Box(tuple(edge + grown for edge in body.half), body.world_from_box) for body in (FRONT, BACK))
        surface = mesh_of(bodies, [1, 2])
        by_ray = (look(surface, NOT_MEASURED).instance != view.instance).sum()
        by_both = (look(surface, view.depth).instance != view.instance).sum()
        assert by_both < 0.5 * by_ray, "what is left is the foot, where mesh and table are one within the tolerance"


def test_a_thin_part_keeps_its_width() -> None:
    rod = box_at(0.0, -0.1, (0.0015, 0.0015, 0.08))
    view = Scene((rod,), SCENE.background).render(K, CAMERA, HEIGHT, WIDTH)
    assert 10 < (view.instance == 1).sum() < 60, "a pixel wide"
    depth = cleaned(noisy(view.depth, 0.001, np.random.default_rng(0)), 0.0, 5.0)
    assert (look(mesh_of((rod,), [1]), depth).instance == view.instance)[view.instance == 1].mean() > 0.95


@pytest.mark.parametrize("width_px", [2, 3])
@pytest.mark.parametrize("share_missing", [0.0, 0.3])
def test_rods_of_two_and_three_pixels_survive_with_noise_and_without_a_part_of_the_depth(
    width_px: int, share_missing: float
) -> None:
    half = width_px * 0.68 / K[0, 0] / 2
    rods = tuple(box_at(x, -0.05, (half, half, 0.08)) for x in (-0.1, 0.0, 0.1))
    view = Scene(rods, SCENE.background).render(K, CAMERA, HEIGHT, WIDTH)
    depth = noisy(view.depth, 0.002, np.random.default_rng(0), share_missing)
    frame = look(mesh_of(rods, [1, 2, 3]), depth)
    on_rod = view.instance > 0
    assert width_px - 0.7 < on_rod[30:50].sum(axis=1).mean() / 3 < width_px + 0.7
    assert (frame.instance == view.instance)[on_rod].mean() > 0.95
    assert (frame.instance[~on_rod] > 0).sum() < 0.05 * on_rod.sum()


def test_pixels_without_measurement_are_marked_where_an_object_may_be_and_nowhere_else() -> None:
    view = SCENE.render(K, CAMERA, HEIGHT, WIDTH)
    depth = view.depth.copy()
    depth[:, ::3] = 0
    frame = look(mesh_of((FRONT, BACK), [1, 2]), depth)
    assert np.array_equal(frame.measured, (depth > 0) | (view.instance == 0))
    assert (frame.instance != view.instance).sum() <= 2, "they follow the ray all the same"


def test_a_measurement_behind_a_flake_of_the_mesh_shows_what_lies_there() -> None:
    # The mesh has a thin sheet before the front box, as a fused volume has before thin walls.
    flake = box_at(0.0, -0.19, (0.04, 0.001, 0.04))
    view = SCENE.render(K, CAMERA, HEIGHT, WIDTH)
    frame = look(mesh_of((FRONT, BACK, flake), [1, 2, 0]), view.depth)
    assert (frame.instance != view.instance).sum() <= 4


def test_a_pinhole_of_half_a_pixel_more_would_show() -> None:
    view = SCENE.render(K, CAMERA, HEIGHT, WIDTH)
    shifted = ray_directions(K - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]), HEIGHT, WIDTH)
    surface = mesh_of((FRONT, BACK), [1, 2])
    wrong = visible_instances(surface, MeasuredFrame(NOT_MEASURED, shifted, K, CAMERA), TOLERANCE)
    right = visible_instances(surface, MeasuredFrame(NOT_MEASURED, DIRECTIONS, K, CAMERA), TOLERANCE)
    assert (right.instance != view.instance).sum() <= 2 < 50 < (wrong.instance != view.instance).sum()


def test_a_scene_without_objects_has_empty_masks() -> None:
    frame = look(mesh_of((), []), SCENE.render(K, CAMERA, HEIGHT, WIDTH).depth)
    assert not frame.instance.any()
    assert frame.visible_fraction.shape == (0,)


def test_what_is_fixed_to_the_camera_is_in_no_mask() -> None:
    occluder = np.zeros((HEIGHT, WIDTH), bool)
    occluder[:, :80] = True
    frame = look(mesh_of((FRONT, BACK), [1, 2]), NOT_MEASURED, occluder=occluder)
    assert not frame.instance[:, :80].any()
    assert frame.instance[:, 80:].any()
    assert frame.n_pixels["fixed_to_camera"] > 100


def test_fused_scene_with_noise_gives_masks_close_to_the_truth() -> None:
    scene, cameras = tabletop(4, seed=5), orbit(16)
    K_fine = intrinsics(240, 320)
    volume, rng = Volume(0.004), np.random.default_rng(0)
    views = [scene.render(K_fine, camera, 240, 320) for camera in cameras]
    depths = [cleaned(noisy(view.depth, 0.001, rng), 0.1, 2.0) for view in views]
    for view, depth, camera in zip(views, depths, cameras, strict=True):
        volume.integrate(depth, view.rgb, K_fine, camera)
    mesh = volume.mesh()
    labels = scene.instance_at(mesh.vertices.astype(float), table_margin=0.002)
    surface = LabelledSurface(mesh.vertices, mesh.triangles, labels, scene.n_objects)
    directions = ray_directions(K_fine, 240, 320)
    both, either = np.zeros(scene.n_objects), np.zeros(scene.n_objects)
    for view, depth, camera in zip(views, depths, cameras, strict=True):
        found = visible_instances(surface, MeasuredFrame(depth, directions, K_fine, camera)).instance
        for label in range(1, scene.n_objects + 1):
            both[label - 1] += ((found == label) & (view.instance == label)).sum()
            either[label - 1] += ((found == label) | (view.instance == label)).sum()
    iou = both / either
    assert iou.mean() > 0.95
    assert iou.min() > 0.92
