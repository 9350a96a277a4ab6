"""The similarity between two sets of poses of the same cameras, some of them perhaps wrong."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from bask_data.core.depth import SIGMA_FROM_MAD
from bask_data.core.geometry import rotation_angle

MOST_TRIED = 40
"""Cameras, spread over all, whose pairs are tried as what the similarity follows from: 780 pairs. If half of the poses
are wrong, a quarter of the pairs are right. Sensitivity not measured."""

REJECTED_BEYOND = 3.0
"""Standard deviations, estimated from the median, beyond which a pose is rejected. Sensitivity not measured."""

NEVER_REJECTED_BELOW = 0.01
"""Deviation up to which no pose is rejected: radians, or as a share of the cameras' spread. Keeps rounding of exact
poses from counting as their noise. Chosen; sensitivity not measured."""

N_FITS = 5
"""Rounds in which rotation and scale, which weigh each other, are fitted in turn; each settles a digit or more."""


@dataclass(frozen=True)
class Similarity:
    """Coordinates in a, times `scale`, moved by the rigid transform `b_from_a`, are coordinates in b.

    Attributes:
        inliers: cameras whose poses agree.
    """

    scale: float
    b_from_a: Float[ndarray, "4 4"]
    inliers: Bool[ndarray, " n"]

    def moved(self, a_from_cameras: Float[ndarray, "*n 4 4"]) -> Float[ndarray, "*n 4 4"]:
        """Poses in a as poses in b."""
        scaled = a_from_cameras.copy()
        scaled[..., :3, 3] *= self.scale
        return self.b_from_a @ scaled


def similarity(
    a_from_cameras: Float[ndarray, "n 4 4"], b_from_cameras: Float[ndarray, "n 4 4"], scale: float | None = None
) -> Similarity:
    """The similarity that takes cameras' poses in a to their poses in b; wrong poses are rejected.

    It is fitted to centres and to orientations: centres alone, as of Umeyama 1991, say little of the rotation about a
    path that is almost straight. The start is the similarity by two cameras with the least median of deviations
    (Rousseeuw 1984).

    Args:
        scale: units of b per unit of a, if it is known.

    Raises:
        ValueError: there are fewer than three cameras, or they are all in one place.
    """
    n = len(a_from_cameras)
    spread = _spread(b_from_cameras)
    if n < 3 or not spread > 0 or not _spread(a_from_cameras) > 0:
        raise ValueError(f"poses: expected three cameras or more in different places, got {n}")
    start = _by_two(a_from_cameras, b_from_cameras, spread, scale)
    deviation = _deviation(start, a_from_cameras, b_from_cameras, spread)
    inliers = deviation <= max(NEVER_REJECTED_BELOW, REJECTED_BEYOND * SIGMA_FROM_MAD * float(np.median(deviation)))
    result = _fitted(a_from_cameras, b_from_cameras, inliers, start.scale, scale)
    deviation = _deviation(result, a_from_cameras, b_from_cameras, spread)
    inliers = deviation <= max(NEVER_REJECTED_BELOW, REJECTED_BEYOND * SIGMA_FROM_MAD * float(np.median(deviation)))
    return _fitted(a_from_cameras, b_from_cameras, inliers, result.scale, scale)


def _spread(world_from_cameras: Float[ndarray, "n 4 4"]) -> float:
    """Median distance of the centres from their middle."""
    centres = world_from_cameras[:, :3, 3]
    return float(np.median(np.linalg.norm(centres - np.median(centres, axis=0), axis=1))) if len(centres) else 0.0


def _by_two(
    a_from_cameras: Float[ndarray, "n 4 4"], b_from_cameras: Float[ndarray, "n 4 4"], spread: float, scale: float | None
) -> Similarity:
    n = len(a_from_cameras)
    tried = np.unique(np.linspace(0, n - 1, min(n, MOST_TRIED)).astype(int))
    best, least = None, np.inf
    for i in tried:
        for j in tried:
            length_a = np.linalg.norm(a_from_cameras[i, :3, 3] - a_from_cameras[j, :3, 3])
            length_b = np.linalg.norm(b_from_cameras[i, :3, 3] - b_from_cameras[j, :3, 3])
            if i == j or not (length_a > 0 and length_b > 0):
                continue
            ratio = float(length_b / length_a) if scale is None else scale
            b_from_a = np.eye(4)
            b_from_a[:3, :3] = b_from_cameras[i, :3, :3] @ a_from_cameras[i, :3, :3].T
            b_from_a[:3, 3] = b_from_cameras[i, :3, 3] - ratio * b_from_a[:3, :3] @ a_from_cameras[i, :3, 3]
            candidate = Similarity(ratio, b_from_a, np.ones(n, bool))
            median = float(np.median(_deviation(candidate, a_from_cameras, b_from_cameras, spread)))
            if median < least:
                best, least = candidate, median
    assert best is not None
    return best


def _deviation(
    fit: Similarity, a_from_cameras: Float[ndarray, "n 4 4"], b_from_cameras: Float[ndarray, "n 4 4"], spread: float
) -> Float[ndarray, " n"]:
    """Deviation of each pose, radians; distances count as a share of the cameras' spread."""
    moved = fit.moved(a_from_cameras)
    distance = np.linalg.norm(moved[:, :3, 3] - b_from_cameras[:, :3, 3], axis=1) / spread
    angle = rotation_angle(np.swapaxes(moved[:, :3, :3], 1, 2) @ b_from_cameras[:, :3, :3])
    return np.hypot(distance, angle)


def _fitted(
    a_from_cameras: Float[ndarray, "n 4 4"],
    b_from_cameras: Float[ndarray, "n 4 4"],
    inliers: Bool[ndarray, " n"],
    start: float,
    scale: float | None,
) -> Similarity:
    """Least squares over the inliers: centres, and orientations as points at the cameras' mean distance."""
    a, b = a_from_cameras[inliers], b_from_cameras[inliers]
    middle_a, middle_b = a[:, :3, 3].mean(axis=0), b[:, :3, 3].mean(axis=0)
    centres_a, centres_b = a[:, :3, 3] - middle_a, b[:, :3, 3] - middle_b
    turned = (b[:, :3, :3] @ np.swapaxes(a[:, :3, :3], 1, 2)).sum(axis=0)
    lever = float((centres_b**2).sum() / len(b)) or 1.0
    ratio = start if scale is None else scale
    rotation = np.eye(3)
    for _ in range(N_FITS):
        left, _, right = np.linalg.svd(ratio * centres_b.T @ centres_a / lever + turned)
        left[:, 2] *= np.linalg.det(left @ right)
        rotation = left @ right
        if scale is None:
            ratio = float((centres_b * (centres_a @ rotation.T)).sum() / max((centres_a**2).sum(), 1e-300))
    b_from_a = np.eye(4)
    b_from_a[:3, :3] = rotation
    b_from_a[:3, 3] = middle_b - ratio * rotation @ middle_a
    return Similarity(ratio, b_from_a, inliers)
