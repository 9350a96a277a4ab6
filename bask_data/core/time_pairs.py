"""Which samples of two streams belong together, by their times."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray


def nearest(time: Float[ndarray, " n"], other: Float[ndarray, " m"], limit: float) -> Int[ndarray, " n"]:
    """Index of the nearest of the other times, seconds, which ascend; -1 if it is more than `limit` away.

    Args:
        other: at least one.
    """
    after = np.clip(np.searchsorted(other, time), 0, len(other) - 1)
    before = np.maximum(after - 1, 0)
    index = np.where(np.abs(other[before] - time) <= np.abs(other[after] - time), before, after)
    return np.where(np.abs(other[index] - time) <= limit, index, -1)


def mutual_nearest(time: Float[ndarray, " n"], other: Float[ndarray, " m"], limit: float) -> Int[ndarray, " n"]:
    """As `nearest`, for pairs that are each other's nearest only, so that nothing is used twice."""
    forth, back = nearest(time, other, limit), nearest(other, time, limit)
    return np.where((forth >= 0) & (back[forth] == np.arange(len(time))), forth, -1)
