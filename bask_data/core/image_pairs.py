"""Which images of a sequence are matched with each other."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np

MOST_EXHAUSTIVE = 60
"""Images up to which each is matched with each. Chosen; sensitivity not measured."""

NEIGHBOURS = (1, 2, 3, 4, 5, 6, 8, 10, 12, 16, 24, 32)
"""Distances, in images, at which the images of a longer sequence are matched. Chosen; sensitivity not measured."""

N_LOOP_IMAGES = 50
"""Images, spread over a longer sequence, that are matched each with each, so that a path that returns is closed.
Chosen; sensitivity not measured."""


def pairs_to_match(n: int) -> list[tuple[int, int]]:
    """Pairs of images to match: all of a few; of a sequence, near ones, and some of all with each other."""
    if n <= MOST_EXHAUSTIVE:
        return list(combinations(range(n), 2))
    near = {(i, i + step) for step in NEIGHBOURS for i in range(n - step)}
    spread = np.unique(np.linspace(0, n - 1, N_LOOP_IMAGES).astype(int)).tolist()
    return sorted(near | set(combinations(spread, 2)))


def spread_pairs(n: int, gaps: Sequence[int], n_per_gap: int, margin: int = 0) -> list[tuple[int, int]]:
    """Pairs of n frames at each of the distances that fit, spread over the recording.

    Args:
        n_per_gap: pairs for each distance, as far as there are so many.
        margin: frames at both ends that are kept free where there is room: at most an eighth of it.
    """
    pairs = []
    for gap in gaps:
        if gap < n:
            free = min(margin, (n - gap) // 8)
            starts = np.linspace(free, n - 1 - gap - free, min(n_per_gap, n - gap)).astype(int)
            pairs += [(int(i), int(i) + gap) for i in np.unique(starts)]
    return pairs
