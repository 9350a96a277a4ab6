"""Poses that stay the same over some frames, and whether depth stays the same, too."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from bask_data.core.warped_depth import DepthView, evidence

LEAST_FROZEN = 3
"""Frames with the same pose that are looked at: two are common where poses come slower than images."""

MOST_RUNS = 3
"""Runs of frames with the same pose that are looked at, the longest ones."""

SAME_AS_BEFORE = 1e-9
"""Difference of matrices up to which poses are the same; measured ones differ by more."""

STILL_SHARE = 0.7
"""Share of the evidence of neighbouring frames that the ends of a run must have if the camera rests. Chosen on some
simulated recordings (benchmarks/doctor_statistics.py, seeds below 100): above 0.9 at rest, below 0.6 otherwise."""


def frozen_runs(world_from_cameras: Float[ndarray, "t 4 4"]) -> list[tuple[int, int]]:
    """First and last frame of the longest runs with the same pose; none if that is all frames."""
    same = np.abs(np.diff(world_from_cameras, axis=0)).max(axis=(1, 2)) <= SAME_AS_BEFORE
    edges = np.flatnonzero(np.diff(np.concatenate([[0], same.astype(int), [0]])))
    runs = [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]
    runs = [(a, b) for a, b in runs if b - a + 1 >= LEAST_FROZEN and b - a + 1 < len(world_from_cameras)]
    return sorted(sorted(runs, key=lambda run: run[0] - run[1])[:MOST_RUNS])


def moved_runs(views: dict[int, DepthView], runs: list[tuple[int, int]], near: float) -> list[tuple[int, int, float]]:
    """The runs between whose ends depth changed, with its evidence for a camera that rests.

    Args:
        views: those of the ends of the runs, at least.
        near: evidence of neighbouring frames under the best hypothesis.
    """
    found = []
    for a, b in runs:
        share = evidence(views[a], views[b], np.eye(4))
        if share < STILL_SHARE * near:
            found.append((a, b, share))
    return found
