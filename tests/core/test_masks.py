from __future__ import annotations

import cv2
import numpy as np
import pytest

from bask_data.core.depth import cleaned
from bask_data.core.masks import (
    Surface,
    VisibleFrame,
    confirmed,
    decided,
    fixed_to_camera,
    noise,
    ray_directions,
    residuals,
    tolerance_of,
    visible_instances,
)
from bask_data.core.tsdf import Volume
from tests.scenes import Box, Plane, Scene, Sphere, intrinsics, look_at, noisy, orbit, tabletop

HEIGHT, WIDTH = 120, 160
K = intrinsics(HEIGHT, WIDTH)
DIRECTIONS = ray_directions(K, HEIGHT, WIDTH)
TOLERANCE = (0.01, 0.01)


def box_at(x: float, y: float, half: tuple[float, float, float] = (0.04, 0.04, 0.04)) -> Box:
    world_from_box = np.eye(4)
    world_from_box[:3, 3] = x, y, half[2]
    return Box(half, world_from_box)


FRONT, BACK = box_at(0.0, -0.1), box_at(0.0, 0.1, (0.06, 0.04, 0.06))
SCENE = Scene((FRONT, BACK), (Plane(extent=0.5),))
CAMERA = look_at((0.05, -0.7, 0.25))
"""From here the front box hides a part of the back one."""


def mesh_of(
    bodies: tuple[Box, ...], labels: list[int], with_table: bool = True, colors: np.ndarray | None = None
) -> Surface:
    """The exact surface as triangles: boxes and a table."""
    vertices, triangles, vertex_label = [], [], []
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    faces = [
        [0, 1, 3],
        [0, 3, 2],
        [4, 6, 7],
        [4, 7, 5],
        [0, 4, 5],
        [0, 5, 1],
        [2, 3, 7],
        [2, 7, 6],
        [0, 2, 6],
        [0, 6, 4],
    ]
    faces += [[1, 5, 7], [1, 7, 3]]
    for body, label in zip(bodies, labels, strict=True):
        triangles += [[corner + 8 * len(vertices) for corner in face] for face in faces]
        vertices.append(corners * body.half @ body.world_from_box[:3, :3].T + body.world_from_box[:3, 3])
        vertex_label += [label] * 8
    n_vertices = 8 * len(bodies)
    if with_table:
        vertices.append(np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], float))
        triangles += [[n_vertices, n_vertices + 1, n_vertices + 2], [n_vertices, n_vertices + 2, n_vertices + 3]]
        vertex_label += [0] * 4
    return Surface(
        np.concatenate(vertices).astype(np.float32),
        np.array(triangles, np.int32),
        np.array(vertex_label, np.int32),
        max(labels, default=0),
        colors,
    )


def look(surface: Surface, depth: np.ndarray, camera: np.ndarray = CAMERA, **more: object) -> VisibleFrame:
    return visible_instances(surface, depth, DIRECTIONS, K, camera, TOLERANCE, **more)


NOT_MEASURED = np.zeros((HEIGHT, WIDTH), np.float32)


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
    wrong = visible_instances(surface, NOT_MEASURED, shifted, K, CAMERA, TOLERANCE)
    right = visible_instances(surface, NOT_MEASURED, DIRECTIONS, K, CAMERA, TOLERANCE)
    assert (right.instance != view.instance).sum() <= 2 < 50 < (wrong.instance != view.instance).sum()


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


def test_a_highlight_without_depth_on_an_object_stays_in_its_mask() -> None:
    view = SCENE.render(K, CAMERA, HEIGHT, WIDTH)
    palette = np.array([[150, 140, 120], [200, 60, 40], [40, 180, 70]], np.uint8)
    rgb, depth = palette[view.instance], view.depth.copy()
    v, u = np.argwhere(view.instance == 1).mean(axis=0).astype(int)
    rgb[v - 6 : v + 7, u - 6 : u + 7], depth[v - 6 : v + 7, u - 6 : u + 7] = 255, 0
    frame = look(mesh_of((FRONT, BACK), [1, 2], colors=PAINTED), depth, rgb=rgb)
    assert (frame.instance != view.instance).sum() <= 2
    assert frame.n_pixels["hidden_by_colour"] == 0


@pytest.mark.parametrize(("a", "b"), [(0.001, 0.005), (0.001, 0.02), (0.003, 0.0), (0.0, 0.01)])
def test_the_noise_of_a_sensor_is_recovered_within_a_fifth(a: float, b: float) -> None:
    surface, rng, samples = mesh_of((FRONT, BACK), [1, 2]), np.random.default_rng(0), []
    hand = Sphere((0.03, -0.25, 0.12), 0.05)
    for camera in orbit(12, radius=0.8):
        # The hand is an outlier the mesh does not know.
        depth = Scene((*SCENE.objects, hand), SCENE.background).render(K, camera, HEIGHT, WIDTH).depth
        off = rng.normal(size=depth.shape) * (a + b * depth)
        measured = np.where(depth > 0, depth + off, 0).astype(np.float32)
        samples.append(residuals(surface, measured, DIRECTIONS, camera))
    found = noise(np.concatenate(samples))
    assert found is not None
    for z in (0.6, 0.8, 1.0):
        assert found[0] + found[1] * z == pytest.approx(a + b * z, rel=0.2)


def test_the_tolerance_follows_the_noise_between_what_the_mesh_and_a_hand_allow() -> None:
    assert noise(np.zeros((10, 2), np.float32)) is None
    assert tolerance_of(None, 0.004) == (0.01, 0.02)
    assert tolerance_of((0.0, 0.0), 0.004) == (0.014, 0.0)
    assert tolerance_of((0.005, 0.005), 0.004) == (0.02, 0.02)
    assert tolerance_of((1.0, 1.0), 0.004) == (0.04, 0.06)


def test_triangles_between_two_instances_are_divided_at_their_middle() -> None:
    vertices = np.array([[-0.3, 0, 0], [0.3, -0.1, 0], [0.3, 0.1, 0]], np.float32)
    surface = Surface(vertices, np.array([[0, 1, 2]], np.int32), np.array([1, 2, 2], np.int32), 2)
    rays = np.array([[0, 0, 1, x, y, -1] for x, y in ((-0.2, 0), (0.2, 0), (0, 0.3))], np.float32)
    _, label = surface.cast(rays)
    assert label.tolist() == [1, 2, 0]


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


def test_pixels_are_decided_by_the_table_of_the_docstring() -> None:
    label = np.full((1, 9), 1, np.uint8)
    rendered = np.full((1, 9), 0.5, np.float32)
    region = np.ones((1, 9), bool)
    cases = {0.5: 1, 0.512: 1, 0.3: 0, 0.9: 0, 0.0: 1}
    for measurement, expected in cases.items():
        depth = np.full((1, 9), measurement, np.float32)
        decision = decided(label, rendered, depth, region, TOLERANCE)
        assert (decision.label == expected).all(), measurement
        assert sum(decision.n_pixels.values()) == 9
        assert (decision.measured == (measurement > 0)).all()
    label[0, 5:], rendered[0, 5:] = 2, 0.8
    depth = np.full((1, 9), 0.8, np.float32)
    decision = decided(label, rendered, depth, region, TOLERANCE)
    assert decision.label[0].tolist() == [0, 0, 0, 2, 2, 2, 2, 2, 2], (
        "corrected within reach of the edge, removed beyond"
    )


def test_pixels_without_measurement_follow_the_measured_ones_around_them() -> None:
    label = np.full((40, 40), 1, np.uint8)
    rendered = np.full((40, 40), 0.5, np.float32)
    depth = np.zeros((40, 40), np.float32)
    depth[::3, :20:3], depth[::3, 20::3] = 0.2, 0.5
    decision = decided(label, rendered, depth, np.ones((40, 40), bool), TOLERANCE)
    assert not decision.label[:, :16].any()
    assert (decision.label[:, 24:] == 1).all()
    assert decision.n_pixels["not_measured_and_hidden"] > 300
    assert np.array_equal(decision.measured, depth > 0)


def gripper_frames(n_frames: int, moving: bool = True, with_pads: bool = True) -> tuple[list, np.ndarray]:
    """A wrist camera over the scene with two pads in its image which give no depth."""
    pads = np.zeros((HEIGHT, WIDTH), bool)
    if with_pads:
        pads[:50, :30] = pads[:50, -30:] = True
    scene, frames = tabletop(4, seed=2), []
    cameras = orbit(n_frames, radius=0.5) if moving else np.stack([orbit(1, radius=0.5)[0]] * n_frames)
    rng = np.random.default_rng(0)
    for camera in cameras:
        view = scene.render(K, camera, HEIGHT, WIDTH)
        rgb = np.where(pads[..., None], np.uint8(40), view.rgb).astype(float) + rng.normal(scale=3, size=view.rgb.shape)
        measured = ~pads & (rng.random(pads.shape) < 0.3)
        frames.append((np.clip(rgb, 0, 255).astype(np.uint8), measured))
    return frames, pads


def test_pads_that_ride_with_the_camera_are_found_from_colour_and_missing_depth() -> None:
    frames, pads = gripper_frames(12)
    found = fixed_to_camera(frames, HEIGHT, WIDTH)
    assert found[pads].mean() > 0.93
    assert found[~pads].mean() < 0.03


def test_nothing_is_taken_for_fixed_without_pads_or_without_motion() -> None:
    assert fixed_to_camera(gripper_frames(12, with_pads=False)[0], HEIGHT, WIDTH).mean() < 0.005
    assert not fixed_to_camera(gripper_frames(12, moving=False)[0], HEIGHT, WIDTH).any()
    assert not fixed_to_camera(gripper_frames(2)[0], HEIGHT, WIDTH).any()
    assert not fixed_to_camera([], HEIGHT, WIDTH).any()


def test_a_bare_wall_is_not_taken_for_fixed_because_its_depth_lies_on_the_mesh() -> None:
    frames, pads = gripper_frames(12)
    confirmed_everywhere = [(rgb, np.ones_like(pads)) for rgb, _ in frames]
    assert not fixed_to_camera(confirmed_everywhere, HEIGHT, WIDTH).any()


def test_depth_on_the_mesh_is_confirmed_and_a_hand_is_not() -> None:
    hand = Sphere((0.03, -0.25, 0.12), 0.03)
    view = Scene((*SCENE.objects, hand), SCENE.background).render(K, CAMERA, HEIGHT, WIDTH)
    seen = confirmed(mesh_of((FRONT, BACK), [1, 2]), view.depth, DIRECTIONS, CAMERA, TOLERANCE)
    assert not seen[view.instance == 3].any()
    assert seen[(view.instance < 3) & (view.depth > 0)].mean() > 0.999
    assert not confirmed(mesh_of((FRONT,), [1]), NOT_MEASURED, DIRECTIONS, CAMERA).any()


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
    surface = Surface(mesh.vertices, mesh.triangles, labels, scene.n_objects)
    directions = ray_directions(K_fine, 240, 320)
    both, either = np.zeros(scene.n_objects), np.zeros(scene.n_objects)
    for view, depth, camera in zip(views, depths, cameras, strict=True):
        found = visible_instances(surface, depth, directions, K_fine, camera).instance
        for label in range(1, scene.n_objects + 1):
            both[label - 1] += ((found == label) & (view.instance == label)).sum()
            either[label - 1] += ((found == label) | (view.instance == label)).sum()
    iou = both / either
    assert iou.mean() > 0.95
    assert iou.min() > 0.92


def test_wrong_arguments_are_refused_in_words() -> None:
    vertices, triangle = np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], np.int32)
    with pytest.raises(ValueError, match="triangles: expected at least one, got none"):
        Surface(vertices, np.zeros((0, 3), np.int32), np.zeros(3, np.int32), 0)
    with pytest.raises(ValueError, match=r"vertex_instance: expected 0\.\.1, got 0\.\.2"):
        Surface(vertices, triangle, np.array([0, 1, 2], np.int32), 1)
    with pytest.raises(ValueError, match="n_instances: expected at most 255, got 256"):
        Surface(vertices, triangle, np.zeros(3, np.int32), 256)
