from __future__ import annotations

import base64

import cv2
import numpy as np
import pytest

from bask_data.drawing.colours import palette
from bask_data.drawing.images import depth_picture, jpeg_uri, resize
from bask_data.drawing.mask_pictures import mask_picture
from bask_data.drawing.match_pictures import matches_picture
from bask_data.drawing.pictures import Mark, crop_picture, heat_picture, marks_picture

GREY = np.full((60, 80, 3), 90, np.uint8)


def decoded(uri: str) -> np.ndarray:
    data = np.frombuffer(base64.b64decode(uri.removeprefix("data:image/jpeg;base64,")), np.uint8)
    return cv2.cvtColor(cv2.imdecode(data, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)


def test_a_data_uri_holds_the_picture():
    picture = np.zeros((40, 60, 3), np.uint8)
    picture[:20] = (250, 10, 20)
    assert np.abs(decoded(jpeg_uri(picture, 95)).astype(int) - picture).mean() < 3


def test_colours_are_distinct_and_do_not_change_when_there_are_more():
    colours = palette(24)
    assert palette(5) == colours[:5]
    far = [np.abs(np.subtract(a, b)).sum() for i, a in enumerate(colours[:8]) for b in colours[:i]]
    assert min(far) > 60


def test_depth_is_grey_where_nothing_was_measured_and_red_where_it_is_far():
    red, _, blue = depth_picture(np.array([[0.0, 0.5, 1.9]], np.float32), 0.5, 2.0)[0].T.astype(int)
    assert (red[0], blue[0]) == (128, 128)
    assert blue[1] > red[1]
    assert red[2] > blue[2]


def test_masks_tint_their_pixels_and_no_others():
    instance = np.zeros((60, 80), np.uint8)
    instance[10:40, 10:40] = 2
    picture = mask_picture(GREY, instance, None, 80)
    changed = (picture != GREY).any(axis=2)
    assert changed[10:40, 10:40].all()
    assert not changed[45:].any()
    assert not changed[:, 45:].any()


def test_outlines_of_true_labels_are_white():
    labels = np.zeros((60, 80), np.uint8)
    labels[5:25, 50:70] = 132
    picture = mask_picture(GREY, np.zeros((60, 80), np.uint8), labels, 80)
    assert picture[5, 50:70].min() > 200
    assert (picture[10:20, 55:65] == 90).all()


def test_marks_are_drawn_where_they_are_and_not_where_they_are_unknown():
    pixel = np.array([40.0, 30.0])
    picture = marks_picture(GREY, [Mark(1, pixel, (255, 0, 0))], 160)
    assert picture[round((30 + 0.5) * 2 - 0.5), round((40 + 0.5) * 2 - 0.5)].tolist() == [255, 0, 0]
    unknown = Mark(1, np.array([np.nan, 3.0]), (255, 0, 0), truth=np.array([np.nan, np.nan]))
    assert (marks_picture(GREY, [unknown], 160) == resize(GREY, 160)).all()


@pytest.mark.parametrize("far", [1e7, -1e7, 1e30, np.inf, np.nan])
def test_marks_far_outside_the_image_are_harmless(far):
    mark = Mark(
        1,
        np.array([far, 5.0]),
        (255, 0, 0),
        trail=np.array([[5.0, 5.0], [far, far]]),
        covariance=np.full((2, 2), far),
        truth=np.array([far, 1.0]),
    )
    assert marks_picture(GREY, [mark], 80).shape == (60, 80, 3)


def test_the_brightest_spot_of_a_heat_map_is_its_maximum():
    heat = np.zeros((30, 40))
    heat[20, 10] = 1e-9
    picture = heat_picture(GREY, heat, [], 80)
    v, u = np.unravel_index(picture.sum(axis=2).argmax(), picture.shape[:2])
    assert (abs(u - 20.5), abs(v - 40.5)) < (2, 2)


def test_the_best_match_is_a_ring_and_ground_truth_a_cross_joined_to_it_unless_occluded():
    mark = Mark(1, np.array([20.0, 30.0]), (0, 255, 0), truth=np.array([60.0, 30.0]))
    heat = np.ones((30, 40))
    bare, drawn, hidden = (
        heat_picture(GREY, heat, marks, 80, truth_seen=seen)
        for marks, seen in (([], True), ([mark], True), ([mark], False))
    )
    assert (drawn[30, 20] == bare[30, 20]).all(), "the match itself stays visible"
    assert drawn[30, 13].tolist() == [0, 255, 0]
    assert drawn[30, 60].tolist() == [255, 255, 255]
    assert (drawn[30, 35:50] > 240).all()
    assert hidden[30, 60].tolist() == [128, 128, 128]
    assert (hidden[30, 35:50] == bare[30, 35:50]).all()


def test_a_crop_has_its_pixel_in_the_middle_even_at_the_edge():
    image = GREY.copy()
    image[0, 0] = (0, 255, 0)
    crop = crop_picture(image, np.array([0.0, 0.0]), 10, 210, (255, 255, 255))
    assert crop.shape == (210, 210, 3)
    assert crop[105, 105].tolist() == [255, 255, 255]
    assert crop[105, 97:100, 1].min() > 150


def test_matches_join_the_two_pixels():
    picture = matches_picture(GREY, GREY, np.array([[40.0, 30.0]]), np.array([[40.0, 30.0]]), 166)
    assert (picture[30, 40:126] != 90).any(axis=1).all()
    assert (picture[50, :80] == 90).all()
