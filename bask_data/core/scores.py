"""Accuracy of masks, matches and keypoints compared with ground truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray


@dataclass(frozen=True)
class Distribution:
    """Statistics of n numbers; NaN where there are none."""

    n: int
    median: float
    mean: float
    p90: float
    largest: float


def distribution(values: Float[ndarray, "..."]) -> Distribution:
    """Median, mean, 90th percentile and maximum of the finite values; `n` counts these."""
    finite = values[np.isfinite(values)].astype(np.float64)
    if not len(finite):
        return Distribution(0, np.nan, np.nan, np.nan, np.nan)
    return Distribution(
        n=len(finite),
        median=float(np.median(finite)),
        mean=float(finite.mean()),
        p90=float(np.percentile(finite, 90)),
        largest=float(finite.max()),
    )
