"""The rigid motion between two sets of points that correspond, most of them perhaps wrongly."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray
from numpy.random import Generator

N_TRIPLES = 300
"""Triples of points that are tried: with a third of the correspondences right, 1 in 27 triples is, and all 300 fail
once in 10^5. Chosen; sensitivity not measured."""


def rigid_fit(points_a: Float[ndarray, "*n k 3"], points_b: Float[ndarray, "*n k 3"]) -> Float[ndarray, "*n 4 4"]:
    """The rigid transforms b_from_a that take points to their partners, with least squares.

    Source: Kabsch 1976.
    """
    centre_a, centre_b = points_a.mean(axis=-2, keepdims=True), points_b.mean(axis=-2, keepdims=True)
    left, _, right = np.linalg.svd(np.swapaxes(points_b - centre_b, -1, -2) @ (points_a - centre_a))
    # The last axis is turned where the best orthogonal matrix is a reflection.
    left[..., :, 2] *= np.linalg.det(left @ right)[..., None]
    b_from_a = np.broadcast_to(np.eye(4), (*points_a.shape[:-2], 4, 4)).copy()
    b_from_a[..., :3, :3] = left @ right
    b_from_a[..., :3, 3] = (centre_b - centre_a @ np.swapaxes(left @ right, -1, -2))[..., 0, :]
    return b_from_a


def robust_rigid_fit(
    points_a: Float[ndarray, "k 3"], points_b: Float[ndarray, "k 3"], tolerance: float, rng: Generator
) -> tuple[Float[ndarray, "4 4"], Bool[ndarray, "k"]]:
    """The transform b_from_a that takes most points to within `tolerance` metres of their partners, and these points.

    Three points always fit: fewer than four inliers mean nothing.

    Raises:
        ValueError: there are fewer than three points.
    """
    k = len(points_a)
    if k < 3:
        raise ValueError(f"points: expected at least 3, got {k}")
    triples = np.argsort(rng.random((N_TRIPLES, k)), axis=1)[:, :3]
    tried = rigid_fit(points_a[triples], points_b[triples])
    moved = points_a @ np.swapaxes(tried[:, :3, :3], -1, -2) + tried[:, None, :3, 3]
    inliers = np.linalg.norm(moved - points_b, axis=-1) <= tolerance
    best = inliers[inliers.sum(axis=1).argmax()]
    if best.sum() < 3:
        return tried[0], np.zeros(k, bool)
    b_from_a = rigid_fit(points_a[best], points_b[best])
    refined = np.linalg.norm(points_a @ b_from_a[:3, :3].T + b_from_a[:3, 3] - points_b, axis=1) <= tolerance
    return b_from_a, refined
