from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bask_data.core.identity_groups import STRONGEST, Grouping, grouped


def odds_of(n: int, pairs: dict[tuple[int, int], float], otherwise: float = -5.0) -> np.ndarray:
    """Log odds of all pairs of n objects, symmetric."""
    odds = np.full((n, n), otherwise)
    for (a, b), value in pairs.items():
        odds[a, b] = odds[b, a] = value
    return odds


def members(grouping: Grouping) -> list[tuple[int, ...]]:
    return [group.members for group in grouping.groups]


def test_likely_pairs_become_groups_and_what_has_no_partner_stays_alone() -> None:
    scans = np.array([0, 0, 1, 1, 2])
    odds = odds_of(5, {(0, 2): 4.0, (0, 4): 3.0, (2, 4): 5.0})
    grouping = grouped(scans, odds, 0.9)
    assert members(grouping) == [(0, 2, 4)]
    assert grouping.alone == (1, 3) and not grouping.tied
    expected = 1 / (1 + np.exp(-np.array([3.5, 4.5, 4.0])))
    np.testing.assert_allclose(grouping.groups[0].confidences, expected)
    assert not grouping.groups[0].twins


def test_a_pair_below_the_confidence_is_not_matched() -> None:
    odds = odds_of(2, {(0, 1): np.log(0.85 / 0.15)})
    assert members(grouped(np.array([0, 1]), odds, 0.9)) == []
    assert members(grouped(np.array([0, 1]), odds, 0.8)) == [(0, 1)]


def test_of_two_candidates_in_a_scan_the_clearly_likelier_one_is_taken_and_the_other_stays_alone() -> None:
    grouping = grouped(np.array([0, 1, 1]), odds_of(3, {(0, 1): 5.5, (0, 2): 2.5}), 0.9)
    assert members(grouping) == [(0, 1)]
    assert grouping.alone == (2,)


def test_two_candidates_that_are_about_as_likely_tie_and_neither_is_matched() -> None:
    grouping = grouped(np.array([0, 1, 1]), odds_of(3, {(0, 1): 4.0, (0, 2): 3.5}), 0.9)
    assert members(grouping) == []
    assert grouping.tied == {0: (1, 2), 1: (0,), 2: (0,)}


def test_a_third_scan_decides_a_tie() -> None:
    # Objects 0 and 3 are surely the same; object 3 tells which of 1 and 2 it is.
    odds = odds_of(4, {(0, 1): 4.0, (0, 2): 3.5, (0, 3): 5.5, (3, 1): 5.0, (3, 2): -5.0})
    grouping = grouped(np.array([0, 1, 1, 2]), odds, 0.9)
    assert members(grouping) == [(0, 1, 3)]


def test_objects_of_one_scan_that_look_the_same_are_twins() -> None:
    scans = np.array([0, 0, 1, 1, 1])
    odds = odds_of(5, {(a, b): 5.0 for a in range(4) for b in range(a)})
    grouping = grouped(scans, odds, 0.9)
    assert members(grouping) == [(0, 1, 2, 3)]
    assert grouping.groups[0].twins
    assert grouping.alone == (4,)


def test_no_scan_has_two_objects_of_a_group_however_much_both_resemble_a_third() -> None:
    odds = odds_of(4, {(0, 2): 5.9, (1, 2): 2.3, (1, 3): 5.9, (0, 3): 2.3})
    assert members(grouped(np.array([0, 0, 1, 1]), odds, 0.9)) == [(0, 2), (1, 3)]


@pytest.mark.parametrize(("between", "expected"), [(4.0, [(0, 1), (2, 3)]), (7.0, [(0, 1, 2, 3)])])
def test_groups_of_objects_that_only_look_alike_stay_apart(between: float, expected: list[tuple[int, ...]]) -> None:
    # Four scans of one object each: two of one box and two of another one, or all of the same.
    odds = odds_of(4, {(0, 1): 8.0, (2, 3): 8.0}, otherwise=between)
    assert members(grouped(np.arange(4), odds, 0.9)) == expected


def test_what_is_stated_is_followed_against_the_evidence() -> None:
    scans = np.array([0, 0, 1, 1])
    odds = odds_of(4, {(0, 2): 5.0, (1, 3): 5.0})
    assert members(grouped(scans, odds, 0.9, same=[(0, 3)])) == [(0, 3)]
    assert members(grouped(scans, odds, 0.9, different=[(2, 0)])) == [(1, 3)]
    [group] = grouped(scans, odds_of(4, {}), 0.9, same=[(0, 3)]).groups
    assert group.confidences[0] == pytest.approx(1 / (1 + np.exp(-STRONGEST)))


def test_contradictions_and_confidences_out_of_range_are_refused() -> None:
    with pytest.raises(ValueError, match="objects 1 and 0 are stated to be the same and to be different"):
        grouped(np.array([0, 1]), odds_of(2, {}), 0.9, same=[(0, 1)], different=[(1, 0)])
    with pytest.raises(ValueError, match="confidence: expected above 0.5 and below 1, got 0.5"):
        grouped(np.array([0, 1]), odds_of(2, {}), 0.5)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**31))
def test_an_order_of_the_objects_changes_nothing(seed: int) -> None:
    rng = np.random.default_rng(seed)
    scans = rng.integers(0, 4, 9)
    odds = rng.normal(0, 4, (9, 9))
    odds = np.where(scans[:, None] == scans, -5.0, (odds + odds.T) / 2)
    order = rng.permutation(9)
    straight, permuted = grouped(scans, odds, 0.8), grouped(scans[order], odds[np.ix_(order, order)], 0.8)
    assert {frozenset(each) for each in members(straight)} == {
        frozenset(order[list(each)].tolist()) for each in members(permuted)
    }
    for group in straight.groups:
        assert len(set(scans[list(group.members)])) == len(group.members)


def test_without_objects_there_are_no_groups() -> None:
    assert grouped(np.zeros(0, int), np.zeros((0, 0)), 0.9) == Grouping((), (), {})
