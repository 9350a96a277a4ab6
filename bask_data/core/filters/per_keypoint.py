"""Settings that may differ between keypoints."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from bask_data.core.filters.table import PerKeypoint


def per_keypoint(value: PerKeypoint, k: int, name: str) -> Float[ndarray, "k"]:
    """A setting's value for each of k keypoints.

    Raises:
        ValueError: it has values for another number of keypoints.
    """
    values = np.asarray(value, dtype=np.float64)
    if values.ndim and len(values) != k:
        raise ValueError(f"{name}: expected one value, or one for each of {k} keypoints, got {len(values)}")
    return np.broadcast_to(values, (k,))
