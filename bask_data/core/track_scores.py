"""How far tracks spread and move, and which objects their keypoints land on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from bask_data.core.landings import OUTSIDE, Landing


def spread(covariance: Float[ndarray, "t k 3 3"]) -> Float[ndarray, "t k"]:
    """Metres: the root of the covariance's trace, which is the root mean square distance from the mean."""
    return np.sqrt(np.maximum(np.trace(covariance, axis1=-2, axis2=-1).astype(np.float64), 0.0))


def step_length(mean: Float[ndarray, "t k 3"]) -> Float[ndarray, "t_minus_1 k"]:
    """Distance that each keypoint moves from a frame to the next, metres; jitter where nothing moves."""
    return np.linalg.norm(np.diff(mean.astype(np.float64), axis=0), axis=-1)


@dataclass(frozen=True)
class ObjectShares:
    """Labels at keypoints over many frames, as shares of the pairs of frame and keypoint whose own object is in view.

    `right` is on the own object; `right`, `other`, `background` and `outside` add up to one.
    """

    n: int
    right: float
    near: float
    other: float
    background: float
    outside: float
    chance: float


def object_shares(landings: Sequence[Landing], chosen: Bool[ndarray, "k"] | None = None) -> ObjectShares:
    """Shares over frames and keypoints.

    Args:
        chosen: only these keypoints.
    """
    if not landings:
        return ObjectShares(0, *[np.nan] * 6)
    counted = np.stack([frame.in_view for frame in landings])
    if chosen is not None:
        counted &= chosen
    n = int(counted.sum())
    if not n:
        return ObjectShares(0, *[np.nan] * 6)
    exact = np.stack([frame.exact for frame in landings])[counted]
    label = np.stack([frame.label for frame in landings])[counted]
    return ObjectShares(
        n=n,
        right=float(exact.mean()),
        near=float(np.stack([frame.near for frame in landings])[counted].mean()),
        other=float(((label > 0) & ~exact).mean()),
        background=float((label == 0).mean()),
        outside=float((label == OUTSIDE).mean()),
        chance=float(np.stack([frame.chance for frame in landings])[counted].mean()),
    )
