from __future__ import annotations

from bask_data.core.image_pairs import MOST_EXHAUSTIVE, pairs_to_match, spread_pairs


def test_pairs_of_a_long_sequence_are_near_ones_and_some_of_all() -> None:
    assert len(pairs_to_match(MOST_EXHAUSTIVE)) == MOST_EXHAUSTIVE * (MOST_EXHAUSTIVE - 1) // 2
    pairs = pairs_to_match(1000)
    assert {(i, i + 1) for i in range(999)} <= set(pairs)
    assert (0, 999) in pairs
    assert all(0 <= a < b < 1000 for a, b in pairs)
    assert len(pairs) < 15000


def test_spread_pairs_have_each_distance_that_fits_and_stay_off_the_ends() -> None:
    pairs = spread_pairs(50, (1, 8, 64), 3, margin=4)
    assert pairs == [(4, 5), (24, 25), (44, 45), (4, 12), (20, 28), (37, 45)]
    assert spread_pairs(3, (1, 2), 5) == [(0, 1), (1, 2), (0, 2)] and spread_pairs(1, (1,), 5) == []
