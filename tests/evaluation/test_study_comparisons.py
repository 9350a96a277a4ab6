from __future__ import annotations

import numpy as np
import pytest

from bask_data.core.filters.table import settings_named
from bask_data.core.keypoint_scores import sighting
from bask_data.core.paired_bootstrap import Difference
from bask_data.evaluation.study_comparisons import comparison_lines, comparisons, verdict
from bask_data.evaluation.study_tracks import Method, Tracked

METHODS = [
    Method("base", "expectation", settings_named("expectation")),
    Method("main", "expectation", settings_named("expectation")),
    Method("main", "particle", settings_named("particle")),
]
N, OUT = 12, slice(6, 9)


def tracked(name: str, offsets: dict[str, float], out_of_view: float = 0.0) -> Tracked:
    """Two keypoints at rest, out of view for three frames; each method's estimate is off by as many metres."""
    places = np.zeros((N, 2, 3))
    inside = np.ones((1, N, 2), dtype=bool)
    inside[0, OUT] = False
    seen = sighting(inside, np.zeros_like(inside), places)
    track = Tracked(name, ["wrist"], [*range(N)], places, seen, np.zeros((1, N, 2, 2)), shown=inside)
    for method, offset in offsets.items():
        track.mean[method] = places + np.array([offset, 0.0, 0.0])
        if method == "base: expectation":
            track.mean[method][OUT] += np.array([0.0, 0.0, out_of_view])
    return track


@pytest.fixture(scope="module")
def tracks() -> list[Tracked]:
    """`main` is 10 mm better with expectation than `base`, and as good with its filter, give or take 1 mm."""
    return [
        tracked(
            f"demo{i}",
            {
                "base: expectation": hard + 0.01,
                "main: expectation": hard,
                "main: particle": hard + (0.001 if i % 2 else -0.001),
            },
        )
        for i, hard in enumerate((0.02, 0.15, 0.05, 0.08, 0.3, 0.02))
    ]


def test_every_pair_of_methods_is_compared_in_every_phase(tracks: list[Tracked]) -> None:
    found = comparisons(tracks, METHODS, 0)
    assert [(pair["a"], pair["b"]) for pair in found] == [
        ("base: expectation", "main: expectation"),
        ("base: expectation", "main: particle"),
        ("main: expectation", "main: particle"),
    ]
    first = found[0]["difference"]
    assert first["all"] == pytest.approx(
        {"mean": 0.01, "low": 0.01, "high": 0.01, "n": 6 * N * 2, "n_demonstrations": 6}
    )
    assert (first["visible"]["n"], first["out of view"]["n"]) == (6 * 9 * 2, 6 * 3 * 2)
    assert first["occluded"] == {"mean": None, "low": None, "high": None, "n": 0, "n_demonstrations": 0}


def test_a_difference_is_claimed_where_the_demonstrations_show_it_and_nowhere_else(tracks: list[Tracked]) -> None:
    verdicts = [pair["verdict"] for pair in comparisons(tracks, METHODS, 0)]
    assert verdicts[0] == "main: expectation < base: expectation by 10.0 mm (95 % interval 10.0 to 10.0)"
    assert verdicts[1].startswith("main: particle < base: expectation by 10.0 mm")
    assert verdicts[2].startswith("main: expectation, main: particle: no difference shown (95 % interval -")


def test_a_phase_has_its_own_difference() -> None:
    offsets = {method.name: 0.0 for method in METHODS}
    found = comparisons([tracked(f"demo{i}", offsets, out_of_view=0.4) for i in range(3)], METHODS, 0)
    difference = found[0]["difference"]
    assert (difference["visible"]["mean"], difference["out of view"]["mean"]) == pytest.approx((0.0, 0.4))


def test_one_demonstration_is_too_few_for_a_claim() -> None:
    offsets = {"base: expectation": 0.5, "main: expectation": 0.1, "main: particle": 0.1}
    found = comparisons([tracked("demo", offsets)], METHODS, 0)
    assert found[0]["difference"]["all"]["mean"] == pytest.approx(0.4)
    assert found[0]["verdict"].endswith("no difference shown (too few demonstrations for an interval)")
    assert "- " in next(line for line in comparison_lines(found) if "base: expectation - main: expectation" in line)


def test_the_better_method_comes_first_whatever_the_order_of_the_table() -> None:
    assert verdict("a", "b", Difference(-0.02, -0.03, -0.01, 9, 3)) == "a < b by 20.0 mm (95 % interval 10.0 to 30.0)"
    assert verdict("a", "b", Difference(0.02, 0.01, 0.03, 9, 3)) == "b < a by 20.0 mm (95 % interval 10.0 to 30.0)"


def test_the_printed_comparison_has_the_difference_and_its_interval(tracks: list[Tracked]) -> None:
    lines = list(comparison_lines(comparisons(tracks, METHODS, 0)))
    assert "6 demonstrations" in lines[0] and "out of view" in lines[0]
    assert lines[1].split("  ")[-1].strip() == "10.0 [10.0, 10.0]"
    assert "1 demonstration " in next(comparison_lines(comparisons(tracks[:1], METHODS, 0)))
    assert not list(comparison_lines([]))
