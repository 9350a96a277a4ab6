"""Comparisons of the methods of a keypoint study: which differences of their errors the demonstrations show."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations
from typing import TYPE_CHECKING, Any

from bask_data.spelling import number_of

if TYPE_CHECKING:
    from bask_data.core.paired_bootstrap import Difference
    from bask_data.evaluation.study_tracks import Method, Tracked

PRINTED = ("all", "visible", "occluded", "out of view")
"""The phases of the printed table; the result has all of them."""


def comparisons(tracks: Sequence[Tracked], methods: Sequence[Method], seed: int) -> list[dict[str, Any]]:
    """Each pair of methods, in the order of the table: differences of their mean errors by phase, as plain JSON values.

    Args:
        tracks: demonstrations, perhaps of several sets of objects.
    """
    import numpy as np

    from bask_data.core.keypoint_scores import PHASES, distances, phases
    from bask_data.core.paired_bootstrap import paired_difference

    errors = {method.name: [distances(track.mean[method.name], track.places) for track in tracks] for method in methods}
    of_frames = [phases(track.places, track.seen) for track in tracks]
    chosen = {
        "all": [np.isfinite(track.places).all(axis=2) for track in tracks],
        **{phase: [frames[phase] for frames in of_frames] for phase in PHASES},
    }
    found = []
    for a, b in combinations(errors, 2):
        # Each comparison draws the same demonstrations, so that none depends on which others are made.
        differences = {
            phase: paired_difference(errors[a], errors[b], masks, np.random.default_rng(seed))
            for phase, masks in chosen.items()
        }
        found.append(
            {
                "a": a,
                "b": b,
                "difference": {phase: _plain(difference) for phase, difference in differences.items()},
                "verdict": verdict(a, b, differences["all"]),
            }
        )
    return found


def verdict(a: str, b: str, difference: Difference) -> str:
    """What may be claimed of two methods: the order of their errors, or that no difference is shown."""
    if math.isnan(difference.low):
        return f"{a}, {b}: no difference shown (too few demonstrations for an interval)"
    low, high = 1000 * difference.low, 1000 * difference.high
    if not difference.is_shown:
        return f"{a}, {b}: no difference shown (95 % interval {low:.1f} to {high:.1f} mm)"
    better, worse = (a, b) if difference.mean < 0 else (b, a)
    least, most = sorted((abs(low), abs(high)))
    return f"{better} < {worse} by {1000 * abs(difference.mean):.1f} mm (95 % interval {least:.1f} to {most:.1f})"


def comparison_lines(found: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """Lines: differences of neighbouring methods by phase, then what may be claimed of each pair."""
    if not found:
        return
    n = max(pair["difference"]["all"]["n_demonstrations"] for pair in found)
    title = f"  difference of means, mm, {number_of(n, 'demonstration')}"
    yield f"{title:<46}" + "".join(f"{phase:>24}" for phase in PRINTED)
    for pair in found:
        cells = "".join(f"{_written(pair['difference'][phase]):>24}" for phase in PRINTED)
        yield f"    {pair['a'] + ' - ' + pair['b']:<62}" + cells
    yield from (f"    {pair['verdict']}" for pair in found)


def _plain(difference: Difference) -> dict[str, float | int | None]:
    """For JSON, metres; None where unknown."""
    values = {"mean": difference.mean, "low": difference.low, "high": difference.high}
    return {
        **{name: None if math.isnan(value) else value for name, value in values.items()},
        "n": difference.n,
        "n_demonstrations": difference.n_demonstrations,
    }


def _written(difference: Mapping[str, Any]) -> str:
    mean, low, high = (difference[name] for name in ("mean", "low", "high"))
    if mean is None or low is None:
        return "-"
    return f"{1000 * mean:.1f} [{1000 * low:.1f}, {1000 * high:.1f}]"
