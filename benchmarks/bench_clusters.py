"""DBSCAN on weighted cells against scikit-learn's on the points: the same clusters, and minutes beyond this size."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from sklearn.cluster import DBSCAN

from bask_data.core.clusters import dbscan

EPS = 0.03
MIN_SAMPLES = 30


def cases() -> Iterator[tuple[str, Callable[[], object], Callable[[], object]]]:
    """Five spheres of 5 cm radius, 20 cm apart, sampled more and more densely."""
    for n_points in (10_000, 50_000):
        rng = np.random.default_rng(0)
        direction = rng.normal(size=(n_points, 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        points = 0.05 * direction
        points[:, 0] += 0.2 * (np.arange(n_points) % 5)
        weights = np.ones(n_points)

        def ours(points: np.ndarray = points, weights: np.ndarray = weights) -> object:
            return dbscan(points, weights, EPS, MIN_SAMPLES)

        def plain(points: np.ndarray = points) -> object:
            return DBSCAN(eps=EPS, min_samples=MIN_SAMPLES).fit(points).labels_

        yield f"DBSCAN, {n_points // 1000} k points", ours, plain
