from __future__ import annotations

import numpy as np
import pytest

from bask_data.core.agreement import AWAY, NEAR, Sightings, agreed_place, joined, sightings_of, tied_distance

SIZE = (61, 61)
MM = 0.002
"""Metres per pixel of a plane that faces the camera."""


def plane() -> np.ndarray:
    v, u = np.mgrid[: SIZE[0], : SIZE[1]] - 30.0
    return np.stack([MM * u, MM * v, np.ones(SIZE)], axis=-1)


def disc(radius: float, hole: float = 0.0) -> np.ndarray:
    away = np.linalg.norm(plane()[..., :2], axis=-1)
    return (away <= radius) & (away >= hole)


def test_a_disc_of_equal_descriptors_is_tied_over_its_whole_width():
    ring = disc(0.05, 0.04)
    z = np.where(ring, 0.1, 1.0)
    assert tied_distance(z, plane(), disc(0.05)) == pytest.approx(0.1, abs=4 * MM)
    # Noise far below the contrast does not break the tie.
    noisy = z + np.random.default_rng(0).uniform(0, 0.02, SIZE)
    assert tied_distance(noisy, plane(), disc(0.05)) > AWAY


def test_a_distinct_point_has_ties_at_its_own_place_only():
    away = np.linalg.norm(plane() - plane()[20, 35], axis=-1)
    z = 1 - np.exp(-0.5 * (away / 0.01) ** 2)
    assert tied_distance(z, plane(), disc(0.05)) < NEAR


def test_two_equal_handles_are_tied_over_their_distance():
    z = np.ones(SIZE)
    z[30, [5, 55]] = 0.2
    assert tied_distance(z, plane(), np.ones(SIZE, bool)) == pytest.approx(50 * MM)
    # One of them hidden, off the objects, or clearly less similar: no tie.
    assert tied_distance(z, plane(), np.arange(61)[None].repeat(61, 0) < 40) == 0
    z[30, 55] = 0.4
    assert tied_distance(z, plane(), np.ones(SIZE, bool)) == 0


def test_scale_and_offset_of_the_descriptor_distance_change_no_ties():
    z = np.random.default_rng(1).uniform(size=SIZE)
    assert tied_distance(z, plane(), disc(0.05)) == tied_distance(7 * z + 3, plane(), disc(0.05))


def test_ties_are_unknown_without_a_measured_object():
    assert np.isnan(tied_distance(np.ones(SIZE), plane(), np.zeros(SIZE, bool)))
    assert np.isnan(tied_distance(np.ones(SIZE), np.full((*SIZE, 3), np.nan), np.ones(SIZE, bool)))


def test_the_agreed_place_is_that_of_most_views():
    matches = np.array([[0, 0, 1], [0.01, 0, 1], [0.5, 0, 1], [np.nan] * 3, [0.005, 0, 1]])
    place, votes = agreed_place(matches)
    np.testing.assert_allclose(place, [0.005, 0, 1])
    assert votes == 3


def test_no_match_agrees_on_no_place():
    place, votes = agreed_place(np.full((4, 3), np.nan))
    assert np.isnan(place).all()
    assert votes == 0


def test_a_point_found_at_one_place_in_three_of_four_views_is_ahead_of_a_scattered_one():
    found = np.array([[0, 0, 1], [0.01, 0, 1], [0, 0.01, 1], [0.3, 0, 1]])
    scattered = np.array([[0, 0, 1], [0.1, 0, 1], [0.2, 0, 1], [0.3, 0, 1]])
    matches = np.stack([found, scattered])
    places = np.stack([agreed_place(each)[0] for each in matches])
    seen = sightings_of(matches, np.ones((2, 4), bool), np.zeros((2, 4)), places)
    assert seen.n_found.tolist() == [3, 1]
    assert seen.n_views.tolist() == [4, 4]
    assert seen.expected_error[0] < seen.expected_error[1]


def test_views_that_do_not_show_the_place_count_for_nothing():
    matches = np.array([[[0.0, 0, 1], [0.5, 0, 1], [0.01, 0, 1]]])
    seen = sightings_of(matches, np.array([[True, False, True]]), np.full((1, 3), 0.1), np.array([[0.0, 0, 1]]))
    assert seen.n_views.tolist() == [2]
    assert seen.expected_error == pytest.approx(0.005)
    assert np.isnan(seen.tied[0, 1])


def test_a_match_without_depth_is_as_wrong_as_the_worst():
    matches = np.array([[[0.0, 0, 1], [np.nan] * 3, [0.2, 0, 1]]])
    seen = sightings_of(matches, np.ones((1, 3), bool), np.zeros((1, 3)), np.array([[0.0, 0, 1]]))
    assert seen.expected_error == pytest.approx((0 + 0.2 + 0.2) / 3)


def test_ties_in_half_of_the_views_make_a_keypoint_ambiguous():
    near, far, unknown = 0.0, AWAY, np.nan
    tied = np.array([[far, near, near], [far, far, near], [far, near, unknown], [unknown] * 3])
    assert Sightings(np.zeros((4, 3)), tied).is_ambiguous.tolist() == [False, True, True, False]


def test_a_keypoint_that_no_view_shows_has_no_expected_error():
    nowhere = sightings_of(np.zeros((1, 2, 3)), np.zeros((1, 2), bool), np.zeros((1, 2)), np.full((1, 3), np.nan))
    assert np.isnan(nowhere.expected_error).all()
    assert joined([], 2).n_views.tolist() == [0, 0]
    assert joined([nowhere, Sightings(np.ones((1, 3)), np.zeros((1, 3)))], 1).n_views.tolist() == [3]
