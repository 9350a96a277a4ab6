"""Splitting a table of objects against scikit-learn's DBSCAN on the same points, which alone is one step of it.

scikit-learn keeps all neighbours of all points: a million dense points need more than 16 GB, so the comparison ends at
200 k. Ours alone does 1 M points; `python benchmarks/bench_objects.py` prints its time, memory and agreement.
"""

from __future__ import annotations

import resource
import time
from collections.abc import Callable, Iterator

import numpy as np
from sklearn.cluster import DBSCAN
from sklearn.metrics import adjusted_rand_score

from bask_data.core.clusters import dbscan

EPS = 0.03
N_OBJECTS = 12
CORE_SHARE = 2e-3
"""Of all points, within eps of a core."""


def tabletop(n_points: int) -> np.ndarray:
    """Points on boxes of 4 to 12 cm on a grid with gaps of 4 cm or more, and a share of 0.5 % of specks between."""
    rng = np.random.default_rng(0)
    n_each = n_points // N_OBJECTS
    parts = []
    for i in range(N_OBJECTS):
        half = rng.uniform(0.02, 0.06, 3)
        unit = rng.uniform(-1, 1, (n_each, 3))
        face = rng.integers(3, size=n_each)
        unit[np.arange(n_each), face] = np.sign(unit[np.arange(n_each), face])
        parts.append(unit * half + [0.16 * (i % 4), 0.16 * (i // 4), half[2]])
    return np.concatenate([*parts, rng.uniform([0, 0, 0], [0.6, 0.5, 0.4], (n_points // 200, 3))])


def cases() -> Iterator[tuple[str, Callable[[], object], Callable[[], object]]]:
    for n_points in (50_000, 200_000):
        points = tabletop(n_points)
        weights, core = np.ones(len(points)), CORE_SHARE * n_points

        def ours(points: np.ndarray = points, weights: np.ndarray = weights, core: float = core) -> np.ndarray:
            return dbscan(points, weights, EPS, core)

        def plain(points: np.ndarray = points, core: float = core) -> np.ndarray:
            return DBSCAN(eps=EPS, min_samples=int(core)).fit(points).labels_

        agreement = adjusted_rand_score(plain(), ours())
        yield f"objects of {n_points // 1000} k points (ARI {agreement:.5f})", ours, plain


def main() -> None:
    """Ours on a million points."""
    points = tabletop(1_000_000)
    weights = np.ones(len(points))
    dbscan(points[::100], weights[::100], EPS, 20.0)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    begun = time.perf_counter()
    labels = dbscan(points, weights, EPS, CORE_SHARE * len(points))
    seconds = time.perf_counter() - begun
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
    print(f"1 M points: {seconds:.2f} s, {grown:.0f} MiB more at the peak, {labels.max() + 1} objects of {N_OBJECTS}")


if __name__ == "__main__":
    main()
