"""Whether a belief's covariance is the spread of its errors, and whether what it says of visibility is true."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray
from scipy.special import gammainc, gammaincinv

LEVELS = tuple(percent / 100 for percent in range(5, 100, 5))
"""Nominal shares of the calibration curve: 5 to 95 %, evenly, so that tails count no more than the middle."""
SIGMAS = (1, 2, 3)
"""Ellipsoids that are named by their half-axes in standard deviations; in 3D they hold 20, 74 and 97 %."""
LEAST_VARIANCE = 1e-12
"""Lower bound of a variance along any axis, square metres: a covariance of zero claims a micrometre."""
INDEFINITE = 1e-4
"""A covariance is invalid if its smallest eigenvalue is below minus this share of the largest: far more than float32
rounds, and no belief has negative variance."""


@dataclass(frozen=True)
class Coverage:
    """How many true positions lie in the ellipsoids that a covariance claims to hold a given share of them.

    Attributes:
        n: pairs of frame and keypoint that are counted.
        n_unknown: left out, as the error or the covariance is unknown (NaN).
        n_invalid: left out, as the covariance is not one: it has a negative eigenvalue.
        within: share within each of `SIGMAS`; expected are 0.199, 0.739, 0.971.
        measured: share within the ellipsoid of each of `LEVELS`, NaN without any.
        error: calibration error, the mean of |measured - nominal| over `LEVELS`; 0 is calibrated, 0.5 the most.
    """

    n: int
    n_unknown: int
    n_invalid: int
    within: Float[ndarray, "s"]
    measured: Float[ndarray, "m"]
    error: float


def chi_square_share(squared: Float[ndarray, "..."]) -> Float[ndarray, "..."]:
    """Share of a 3D Gaussian within a squared Mahalanobis distance: chi-square with three degrees of freedom."""
    return gammainc(1.5, np.asarray(squared, dtype=np.float64) / 2)


def mahalanobis_squared(offset: Float[ndarray, "n 3"], covariance: Float[ndarray, "n 3 3"]) -> Float[ndarray, " n"]:
    """(x - mean)^T covariance^-1 (x - mean), with no variance below `LEAST_VARIANCE`.

    NaN where anything is unknown, infinite where the covariance is indefinite.

    Args:
        offset: x - mean, metres.
        covariance: square metres.
    """
    squared = np.full(len(offset), np.nan)
    known = np.isfinite(offset).all(axis=-1) & np.isfinite(covariance).all(axis=(-2, -1))
    if not known.any():
        return squared
    variance, axes = np.linalg.eigh(covariance[known].astype(np.float64))
    along = np.einsum("nij,ni->nj", axes, offset[known].astype(np.float64))
    within = (along**2 / np.maximum(variance, LEAST_VARIANCE)).sum(axis=1)
    # Eigenvalues ascend.
    squared[known] = np.where(variance[:, 0] < -INDEFINITE * np.abs(variance[:, 2]), np.inf, within)
    return squared


def coverage(offset: Float[ndarray, "n 3"], covariance: Float[ndarray, "n 3 3"]) -> Coverage:
    """Measured against nominal shares of true positions in a covariance's ellipsoids.

    Args:
        offset: true position minus mean, metres; NaN where unknown.
        covariance: square metres; NaN where unknown.
    """
    squared = mahalanobis_squared(offset, covariance)
    unknown, invalid = np.isnan(squared), np.isinf(squared)
    counted = squared[~unknown & ~invalid]
    if not len(counted):
        nothing = np.full(len(LEVELS), np.nan)
        return Coverage(0, int(unknown.sum()), int(invalid.sum()), nothing[: len(SIGMAS)], nothing, float("nan"))
    measured = _shares(counted, 2 * gammaincinv(1.5, np.array(LEVELS)))
    return Coverage(
        n=len(counted),
        n_unknown=int(unknown.sum()),
        n_invalid=int(invalid.sum()),
        within=_shares(counted, np.array(SIGMAS, dtype=np.float64) ** 2),
        measured=measured,
        error=float(np.abs(measured - LEVELS).mean()),
    )


def _shares(squared: Float[ndarray, " n"], limits: Float[ndarray, " m"]) -> Float[ndarray, " m"]:
    """Share of the values up to each limit."""
    return np.searchsorted(np.sort(squared), limits, side="right") / len(squared)


@dataclass(frozen=True)
class Claims:
    """A yes-or-no claim compared with ground truth, over n pairs of frame and keypoint; NaN where nothing was claimed,
    or nothing is true.

    Attributes:
        n_claimed, n_true: pairs of which it was claimed, and of which it is true.
        precision: share of the claims that are true.
        recall: share of what is true that was claimed.
    """

    n: int
    n_claimed: int
    n_true: int
    precision: float
    recall: float


def claims(
    claimed: Bool[ndarray, "..."], is_true: Bool[ndarray, "..."], known: Bool[ndarray, "..."] | None = None
) -> Claims:
    """Precision and recall of a claim.

    Args:
        known: where ground truth is known; everywhere by default.
    """
    known = np.ones(claimed.shape, dtype=bool) if known is None else known
    claimed, is_true = claimed & known, is_true & known
    both, n_claimed, n_true = int((claimed & is_true).sum()), int(claimed.sum()), int(is_true.sum())
    return Claims(
        n=int(known.sum()),
        n_claimed=n_claimed,
        n_true=n_true,
        precision=both / n_claimed if n_claimed else float("nan"),
        recall=both / n_true if n_true else float("nan"),
    )
