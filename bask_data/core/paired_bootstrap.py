"""Paired bootstrap: whether demonstrations show that two methods differ in their mean error."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray
from numpy.random import Generator

LEVEL = 0.95
"""Probability with which an interval is to hold the true difference: the usual one."""
N_RESAMPLES = 10_000
"""Resampled sets of demonstrations. The ends of an interval then vary with the seed by 1 % of its width (20 simulated
demonstrations)."""


@dataclass(frozen=True)
class Difference:
    """Difference of two mean errors, metres: negative where the first method is more accurate.

    Attributes:
        mean: NaN without a frame in which both methods have an estimate.
        low, high: ends of the interval; NaN with fewer than two demonstrations, which show no variation.
        n: number of frames and keypoints.
        n_demonstrations: that have any of these.
    """

    mean: float
    low: float
    high: float
    n: int
    n_demonstrations: int

    @property
    def is_shown(self) -> bool:
        """Whether the interval excludes zero."""
        return self.low > 0 or self.high < 0


def paired_difference(
    a: Sequence[Float[ndarray, "_ _"]],
    b: Sequence[Float[ndarray, "_ _"]],
    chosen: Sequence[Bool[ndarray, "_ _"]],
    rng: Generator,
    level: float = LEVEL,
) -> Difference:
    """Difference of the mean errors of two methods, over the chosen frames and keypoints of several demonstrations.

    Only frames and keypoints that both methods have an estimate of count. Demonstrations are resampled as a whole,
    because the frames and keypoints of one are not independent; keypoints are those of the table, not a sample of
    others.

    Args:
        a, b: errors (t, k) in each demonstration, metres; NaN where there is no estimate or no ground truth.

    Raises:
        ValueError: `level` is not between 0 and 1.
    """
    if not 0 < level < 1:
        raise ValueError(f"level: expected between 0 and 1, got {level}")
    sums, counts = np.zeros(len(a)), np.zeros(len(a))
    for i, (one, other, mask) in enumerate(zip(a, b, chosen, strict=True)):
        difference = one[mask] - other[mask]
        known = np.isfinite(difference)
        sums[i], counts[i] = difference[known].sum(), known.sum()
    sums, counts = sums[counts > 0], counts[counts > 0]
    if not len(sums):
        return Difference(math.nan, math.nan, math.nan, 0, 0)
    low, high = _interval(sums, counts, rng, level) if len(sums) > 1 else (math.nan, math.nan)
    return Difference(float(sums.sum() / counts.sum()), low, high, int(counts.sum()), len(sums))


def _interval(
    sums: Float[ndarray, "d"], counts: Float[ndarray, "d"], rng: Generator, level: float
) -> tuple[float, float]:
    """Percentiles of the mean over resampled demonstrations, wider for few of them.

    The plain percentiles are too narrow for few demonstrations, by what a normal quantile lacks of Student's and the
    factor d of d - 1.

    Source: Hesterberg 2015, What Teachers Should Know About the Bootstrap: the expanded percentile interval.
    """
    from scipy.stats import t

    d = len(sums)
    drawn = rng.multinomial(d, np.full(d, 1 / d), size=N_RESAMPLES)
    means = (drawn @ sums) / (drawn @ counts)
    tail = NormalDist().cdf(-math.sqrt(d / (d - 1)) * float(t.ppf((1 + level) / 2, d - 1)))
    low, high = np.quantile(means, [tail, 1 - tail])
    return float(low), float(high)
