"""DBSCAN on occupied cells: the clusters of DBSCAN on the points, at the cost of the surface, not of the points."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from sklearn.cluster import DBSCAN

CELLS_PER_EPS = 6
"""Cells are this much smaller than `eps`. Every point moves to its cell's centre of mass, on average a fifth of a
cell: 3 % of `eps`."""


def cells_of(points: Float[ndarray, "n 3"], size: float) -> Int[ndarray, "n"]:
    """For each point the number of its cell; cells are numbered 0, 1, ... in the order of their coordinates."""
    ijk = np.floor((points - points.min(axis=0)) / size).astype(np.int64)
    extent = ijk.max(axis=0) + 1
    key = (ijk[:, 0] * extent[1] + ijk[:, 1]) * extent[2] + ijk[:, 2]
    return np.unique(key, return_inverse=True)[1].reshape(-1)


def dbscan(
    points: Float[ndarray, "n 3"],
    weights: Float[ndarray, "n"],
    eps: float,
    core_weight: float,
    cells_per_eps: int = CELLS_PER_EPS,
) -> Int[ndarray, "n"]:
    """Cluster of each point, numbered from 0; -1 is noise.

    A point is a core when the weights within `eps` of it, its own included, reach `core_weight`. With weights 1 that
    is the customary `min_samples`; with the surface area of each vertex it does not depend on how finely the surface
    is sampled.

    Args:
        eps: metres between neighbours.

    Raises:
        ValueError: `eps` or `core_weight` is not positive.

    Source: Ester et al. 1996, on cells.
    """
    if eps <= 0 or core_weight <= 0:
        raise ValueError(f"eps and core_weight must be > 0, got {eps} and {core_weight}")
    if not len(points):
        return np.zeros(0, np.int64)
    cell = cells_of(points, eps / cells_per_eps)
    n_points = np.bincount(cell)
    centre = np.stack([np.bincount(cell, weights=axis) for axis in points.T], axis=1) / n_points[:, None]
    weight = np.bincount(cell, weights=weights)
    # scikit-learn wants an integer min_samples, so the weights carry the scale. The slack keeps sums that equal
    # `core_weight` up to rounding from depending on the order they were added in.
    clusters = DBSCAN(eps=eps, min_samples=1, algorithm="kd_tree").fit(
        centre, sample_weight=weight / core_weight * (1 + 1e-9)
    )
    return clusters.labels_.astype(np.int64)[cell]
