from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from bask_data.core.time_pairs import mutual_nearest, nearest

times = st.lists(st.integers(0, 1000), min_size=1, max_size=30, unique=True).map(
    lambda v: np.sort(np.array(v, dtype=float))
)


@given(times, times, st.integers(0, 50))
def test_the_nearest_time_agrees_with_a_full_search(time: np.ndarray, other: np.ndarray, limit: int) -> None:
    gap = np.abs(time[:, None] - other[None])
    index = nearest(time, other, float(limit))
    assert np.array_equal(index >= 0, gap.min(axis=1) <= limit)
    kept = index >= 0
    assert np.array_equal(gap[np.arange(len(time)), index][kept], gap.min(axis=1)[kept])


@given(times, times, st.integers(0, 50))
def test_nothing_is_used_twice(time: np.ndarray, other: np.ndarray, limit: int) -> None:
    index = mutual_nearest(time, other, float(limit))
    used = index[index >= 0]
    assert len(set(used.tolist())) == len(used)
    assert (np.abs(other[used] - time[index >= 0]) <= limit).all()
    for i, k in zip(np.flatnonzero(index >= 0), used, strict=True):
        assert np.abs(other - time[i]).min() == abs(other[k] - time[i]) == np.abs(time - other[k]).min()
