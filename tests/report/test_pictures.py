from __future__ import annotations

import base64

import cv2
import numpy as np
import pytest

from bask_data.report import pictures as draw
from bask_data.report.figures import plain, spread_frames
from bask_data.report.plots import Curve, line_plot
from tests.scenes import intrinsics, look_at

GREY = np.full((60, 80, 3), 90, np.uint8)


def decoded(uri: str) -> np.ndarray:
    data = np.frombuffer(base64.b64decode(uri.removeprefix("data:image/jpeg;base64,")), np.uint8)
    return cv2.cvtColor(cv2.imdecode(data, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)


def test_a_data_uri_holds_the_picture():
    picture = np.zeros((40, 60, 3), np.uint8)
    picture[:20] = (250, 10, 20)
    assert np.abs(decoded(draw.jpeg_uri(picture, 95)).astype(int) - picture).mean() < 3


def test_colours_are_distinct_and_do_not_change_when_there_are_more():
    colours = draw.palette(24)
    assert draw.palette(5) == colours[:5]
    far = [np.abs(np.subtract(a, b)).sum() for i, a in enumerate(colours[:8]) for b in colours[:i]]
    assert min(far) > 60


def test_depth_is_grey_where_nothing_was_measured_and_red_where_it_is_far():
    red, _, blue = draw.depth_picture(np.array([[0.0, 0.5, 1.9]], np.float32), 0.5, 2.0)[0].T.astype(int)
    assert (red[0], blue[0]) == (128, 128)
    assert blue[1] > red[1]
    assert red[2] > blue[2]


def test_masks_tint_their_pixels_and_no_others():
    instance = np.zeros((60, 80), np.uint8)
    instance[10:40, 10:40] = 2
    picture = draw.mask_picture(GREY, instance, None, 80)
    changed = (picture != GREY).any(axis=2)
    assert changed[10:40, 10:40].all()
    assert not changed[45:].any()
    assert not changed[:, 45:].any()


def test_outlines_of_true_labels_are_white():
    labels = np.zeros((60, 80), np.uint8)
    labels[5:25, 50:70] = 132
    picture = draw.mask_picture(GREY, np.zeros((60, 80), np.uint8), labels, 80)
    assert picture[5, 50:70].min() > 200
    assert (picture[10:20, 55:65] == 90).all()


def test_marks_are_drawn_where_they_are_and_not_where_they_are_unknown():
    pixel = np.array([40.0, 30.0])
    picture = draw.marks_picture(GREY, [draw.Mark(1, pixel, (255, 0, 0))], 160)
    assert picture[round((30 + 0.5) * 2 - 0.5), round((40 + 0.5) * 2 - 0.5)].tolist() == [255, 0, 0]
    unknown = draw.Mark(1, np.array([np.nan, 3.0]), (255, 0, 0), truth=np.array([np.nan, np.nan]))
    assert (draw.marks_picture(GREY, [unknown], 160) == draw.resize(GREY, 160)).all()


@pytest.mark.parametrize("far", [1e7, -1e7, 1e30, np.inf, np.nan])
def test_marks_far_outside_the_image_break_nothing(far):
    mark = draw.Mark(
        1,
        np.array([far, 5.0]),
        (255, 0, 0),
        trail=np.array([[5.0, 5.0], [far, far]]),
        covariance=np.full((2, 2), far),
        truth=np.array([far, 1.0]),
    )
    assert draw.marks_picture(GREY, [mark], 80).shape == (60, 80, 3)


def test_the_brightest_spot_of_a_heat_map_is_its_maximum():
    heat = np.zeros((30, 40))
    heat[20, 10] = 1e-9
    picture = draw.heat_picture(GREY, heat, [], 80)
    v, u = np.unravel_index(picture.sum(axis=2).argmax(), picture.shape[:2])
    assert (abs(u - 20.5), abs(v - 40.5)) < (2, 2)


def test_the_best_match_is_a_ring_and_the_truth_a_cross_joined_to_it_unless_hidden():
    mark = draw.Mark(1, np.array([20.0, 30.0]), (0, 255, 0), truth=np.array([60.0, 30.0]))
    heat = np.ones((30, 40))
    bare, drawn, hidden = (
        draw.heat_picture(GREY, heat, marks, 80, truth_seen=seen)
        for marks, seen in (([], True), ([mark], True), ([mark], False))
    )
    assert (drawn[30, 20] == bare[30, 20]).all(), "the spot itself stays to be seen"
    assert drawn[30, 13].tolist() == [0, 255, 0]
    assert drawn[30, 60].tolist() == [255, 255, 255]
    assert (drawn[30, 35:50] > 240).all()
    assert hidden[30, 60].tolist() == [128, 128, 128]
    assert (hidden[30, 35:50] == bare[30, 35:50]).all()


def test_a_crop_has_its_pixel_in_the_middle_even_at_the_edge():
    image = GREY.copy()
    image[0, 0] = (0, 255, 0)
    crop = draw.crop_picture(image, np.array([0.0, 0.0]), 10, 210, (255, 255, 255))
    assert crop.shape == (210, 210, 3)
    assert crop[105, 105].tolist() == [255, 255, 255]
    assert crop[105, 97:100, 1].min() > 150


def test_matches_join_the_two_pixels():
    picture = draw.matches_picture(GREY, GREY, np.array([[40.0, 30.0]]), np.array([[40.0, 30.0]]), 166)
    assert (picture[30, 40:126] != 90).any(axis=1).all()
    assert (picture[50, :80] == 90).all()


def test_curves_take_the_page_s_ink_and_name_nothing_outside():
    x = np.arange(50.0)
    svg = line_plot([Curve(x, 1 / (x + 1), "#d08020"), Curve(x, x, "")], x_label="frame", y_label="m", logarithmic=True)
    assert svg.startswith("<svg")
    assert svg.endswith("</svg>")
    assert "currentColor" in svg
    assert "http" not in svg
    assert "mathdefault" not in svg


def test_a_curve_of_nothing_is_still_a_plot():
    assert "<svg" in line_plot([Curve(np.arange(3), np.full(3, np.nan), "")], x_label="", y_label="", logarithmic=True)
    assert "<svg" in line_plot([], x_label="", y_label="")


def test_frames_are_spread_from_first_to_last():
    assert spread_frames(100, 3) == [0, 50, 99]
    assert spread_frames(2, 8) == [0, 1]
    assert spread_frames(0, 8) == []


def test_plain_values_are_json():
    assert plain({1: np.float32("nan"), "a": (np.int64(3), np.array([np.inf, 1.0]))}) == {
        "1": None,
        "a": [3, [None, 1.0]],
    }


def sphere(radius: float = 0.1) -> tuple[np.ndarray, np.ndarray]:
    import open3d as o3d

    mesh = o3d.geometry.TriangleMesh.create_sphere(radius, 30)
    return np.asarray(mesh.vertices, np.float32), np.asarray(mesh.triangles, np.int32)


def test_a_mesh_is_drawn_in_its_colours_on_the_background():
    from bask_data.report.mesh import BACKGROUND, MeshScene, Viewpoint

    vertices, triangles = sphere()
    view = Viewpoint(intrinsics(48, 64), look_at((0.4, 0.0, 0.0)), 48, 64)
    red = np.tile(np.array([200, 0, 0], np.uint8), (len(vertices), 1))
    picture = MeshScene(vertices, triangles).render(red, view)
    assert picture[0, 0].tolist() == list(BACKGROUND)
    assert picture[24, 32, 0] > 190
    assert picture[24, 32, 1:].max() == 0
    rim = picture[24, :, 0][(picture[24, :, 1] == 0)]
    assert rim[0] < 150, "a surface seen from the side is darker"


def test_backs_of_faces_are_looked_through():
    from bask_data.report.mesh import BACKGROUND, MeshScene, Viewpoint

    vertices, triangles = sphere()
    inside_out = np.ascontiguousarray(triangles[:, ::-1])
    colours = np.zeros((len(vertices), 3), np.uint8)
    colours[vertices[:, 0] < 0] = (0, 200, 0)
    view = Viewpoint(intrinsics(48, 64), look_at((0.4, 0.0, 0.0)), 48, 64)
    picture = MeshScene(vertices, inside_out).render(colours, view, sharp=True)
    assert picture[24, 32, 1] > 180, "the far wall is seen through the near one"
    assert picture[0, 0].tolist() == list(BACKGROUND)


def test_views_from_above_show_the_whole_mesh_and_the_cameras():
    from bask_data.core.geometry import in_image, invert_rigid, project, transform
    from bask_data.report.mesh import orbit_views

    vertices, _ = sphere()
    cameras = np.stack([look_at((0.4, y, 0.3)) for y in np.linspace(-0.2, 0.2, 5)])
    with_cameras, without = orbit_views(vertices, cameras, np.array([0.0, 0, 1]), height=60, width=80)
    for view, points in ((with_cameras, np.concatenate([vertices, cameras[:, :3, 3]])), (without, vertices)):
        pixel, z = project(transform(invert_rigid(view.world_from_camera), points.astype(float)), view.K)
        assert (z > 0).all()
        assert in_image(pixel, 60, 80).all()
        assert max(np.ptp(pixel[:, 0]) / 80, np.ptp(pixel[:, 1]) / 60) > 0.85, "fills the picture"
        assert view.world_from_camera[2, 3] > 0.1, "from above"
