from __future__ import annotations

from bask_data.core.image_pairs import MOST_EXHAUSTIVE, pairs_to_match


def test_pairs_of_a_long_sequence_are_near_ones_and_some_of_all() -> None:
    assert len(pairs_to_match(MOST_EXHAUSTIVE)) == MOST_EXHAUSTIVE * (MOST_EXHAUSTIVE - 1) // 2
    pairs = pairs_to_match(1000)
    assert {(i, i + 1) for i in range(999)} <= set(pairs)
    assert (0, 999) in pairs
    assert all(0 <= a < b < 1000 for a, b in pairs)
    assert len(pairs) < 15000
