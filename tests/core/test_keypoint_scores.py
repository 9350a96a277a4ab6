from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bask_data.core.keypoint_scores import (
    CLOSE,
    PHASES,
    Sighting,
    distances,
    errors,
    moving,
    over_time,
    phases,
    returning,
    share_over_time,
    sighting,
    z_counts,
    z_edges,
)


def flags(text: str) -> np.ndarray:
    """One keypoint's frames (t, 1): x is true."""
    return np.array([[letter == "x"] for letter in text])


def test_what_any_camera_shows_is_visible_and_what_none_holds_is_out_of_view() -> None:
    inside = np.array([[[True, True, False, True]], [[False, True, False, False]]])
    hidden = np.array([[[True, True, False, False]], [[False, False, False, False]]])
    seen = sighting(inside, hidden, np.zeros((1, 4, 3)))
    assert seen.visible.tolist() == [[False, True, False, True]]
    assert seen.occluded.tolist() == [[True, False, False, False]]
    assert seen.out_of_view.tolist() == [[False, False, True, False]]


def test_a_point_whose_place_is_unknown_is_in_no_phase() -> None:
    places = np.full((3, 1, 3), np.nan)
    everywhere = np.ones((1, 3, 1), bool)
    found = phases(places, sighting(everywhere, ~everywhere, places))
    assert not any(mine.any() for mine in found.values())


@given(st.lists(st.sampled_from("vho"), min_size=1, max_size=30), st.integers(0, 2**31))
def test_every_frame_is_in_exactly_one_state_and_either_moves_or_not(states: list[str], seed: int) -> None:
    rows = np.array([[state] for state in states])
    places = np.cumsum(np.random.default_rng(seed).choice([0.0, 0.1], (len(states), 1, 3)), axis=0)
    found = phases(places, Sighting(rows == "v", rows == "h", rows == "o"))
    assert tuple(found) == PHASES
    exclusive = ("visible", "occluded", "out of view", "not seen yet")
    assert (sum(found[name].astype(int) for name in exclusive) == 1).all()
    assert (found["moving"] ^ found["still"]).all()
    assert (found["returning"] <= found["visible"]).all()


def test_until_a_point_was_seen_once_it_is_neither_hidden_nor_out_of_view() -> None:
    seen = Sighting(flags("...x..."), flags(".x...x."), flags("x.x.x.x"))
    found = phases(np.zeros((7, 1, 3)), seen)
    assert found["not seen yet"][:, 0].tolist() == [True, True, True, False, False, False, False]
    assert found["occluded"][:, 0].tolist() == [False] * 5 + [True, False]
    assert found["out of view"][:, 0].tolist() == [False] * 4 + [True, False, True]


@pytest.mark.parametrize(
    ("visible", "expected"),
    [
        ("xxx...xxxxx", "......xxx.."),  # Lost for as long as it takes, and back.
        ("xxx..xxxxxx", "..........."),  # Hardly lost.
        ("...xxxxxxxx", "..........."),  # Never seen before: no return.
        ("x...x.xx...", "....x.x...."),  # Lost again on its return: these frames do not count, the time does.
        ("x...xxxx...xxxx", "....xxx....xxx."),
    ],
)
def test_a_return_is_the_first_frames_after_a_point_was_lost(visible: str, expected: str) -> None:
    assert returning(flags(visible), n=3)[:, 0].tolist() == flags(expected)[:, 0].tolist()


def test_a_point_moves_from_the_frame_on_that_finds_it_elsewhere() -> None:
    places = np.array([0.0, 0.0, 0.002, 0.0025, 0.0055])[:, None, None] * np.array([1.0, 0.0, 0.0])
    assert moving(places)[:, 0].tolist() == [False, False, True, False, True]


def test_distances_are_of_each_keypoint_and_frame_and_unknown_where_either_is() -> None:
    a = np.zeros((2, 2, 3))
    b = np.array([[[3.0, 4.0, 0.0], [0.0, 0.0, 1.0]], [[np.nan, 0.0, 0.0], [0.0, 2.0, 0.0]]])
    np.testing.assert_array_equal(distances(a, b), [[5.0, 1.0], [np.nan, 2.0]])


def test_figures_are_over_all_chosen_frames_and_the_deviation_is_between_tracks() -> None:
    first = np.array([[0.01, 0.05], [0.03, 0.05], [9.0, np.nan]])
    second = np.array([[0.015]])
    chosen = np.array([[True, True], [True, True], [False, True]])
    found = errors([first, second], [chosen, np.array([[True]])])
    assert (found.n, found.n_unknown) == (5, 1)
    values = [0.01, 0.05, 0.03, 0.05, 0.015]
    assert found.mean == pytest.approx(np.mean(values))
    assert found.median == pytest.approx(0.03)
    assert found.p90 == pytest.approx(np.percentile(values, 90))
    assert found.deviation == pytest.approx(np.std([0.02, 0.05, 0.015]))
    assert found.close == pytest.approx(sum(value < CLOSE for value in values) / 6)


def test_without_any_frame_figures_are_unknown_and_without_any_estimate_nothing_is_close() -> None:
    nothing = errors([np.ones((2, 1))], [np.zeros((2, 1), bool)])
    assert (nothing.n, nothing.n_unknown) == (0, 0)
    assert np.isnan([nothing.mean, nothing.median, nothing.deviation, nothing.p90, nothing.close]).all()
    lost = errors([np.full((2, 1), np.nan)], [np.ones((2, 1), bool)])
    assert (lost.n, lost.n_unknown, lost.close) == (0, 2, 0.0)


def test_recordings_of_all_lengths_are_laid_over_each_other_from_first_to_last_frame() -> None:
    short, long = np.array([[1.0], [3.0]]), np.linspace(0.0, 8.0, 101)[:, None]
    found = over_time([short, long], 5)
    np.testing.assert_allclose(found.mean, [0.5, 1.5, 2.5, 4.5, 5.5])
    np.testing.assert_allclose(found.deviation, [0.5, 0.5, 1.5, 1.5, 2.5])


def test_an_unknown_distance_is_left_out_of_its_moment_and_a_moment_of_none_is_unknown() -> None:
    found = over_time([np.array([[1.0, np.nan], [np.nan, np.nan]])], 2)
    np.testing.assert_array_equal(found.mean, [1.0, np.nan])
    np.testing.assert_array_equal(found.deviation, [0.0, np.nan])


def test_the_share_of_a_phase_is_of_all_keypoints() -> None:
    np.testing.assert_allclose(share_over_time([flags("x."), np.array([[True, False], [False, False]])], 2), [2 / 3, 0])


def test_pixels_are_counted_by_distance_and_group_and_none_is_lost_at_the_ends() -> None:
    edges = z_edges(0.1, 10.0, 2)
    np.testing.assert_allclose(edges, [0.1, 1.0, 10.0])
    distance = np.array([[[0.0, 0.5, 2.0], [1.0, 99.0, 0.2]]])
    left = np.array([[[True, True, False], [True, False, False]]])
    found = z_counts(distance, {"left": left, "right": ~left}, edges)
    assert {name: counts.tolist() for name, counts in found.items()} == {"left": [2, 1], "right": [1, 2]}
