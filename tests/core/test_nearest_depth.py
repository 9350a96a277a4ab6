from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from bask_data.core.nearest_depth import fill_depth, shrink_depth


def test_missing_depth_is_filled_from_the_nearest_measurement() -> None:
    depth = np.zeros((7, 9), dtype=np.float32)
    depth[3, 1], depth[3, 7] = 1.0, 2.0
    filled = fill_depth(depth)
    np.testing.assert_array_equal(filled[3], [1, 1, 1, 1, filled[3, 4], 2, 2, 2, 2])
    assert np.isnan(fill_depth(np.zeros((3, 3), dtype=np.float32))).all()


@given(st.integers(1, 12), st.integers(1, 12), st.integers(0, 2**32 - 1))
def test_shrunk_depths_were_all_measured_and_no_measured_block_is_empty(height: int, width: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    depth = (rng.uniform(0.5, 3, (12, 12)) * (rng.random((12, 12)) < 0.3)).astype(np.float32)
    shrunk = shrink_depth(depth, (height, width))
    assert shrunk.shape == (height, width)
    assert np.isin(shrunk, np.append(depth, 0)).all()
    assert (shrunk > 0).any() == (depth > 0).any()


def test_shrinking_takes_the_nearer_surface_where_the_centre_has_none() -> None:
    depth = np.array([[0, 2, 1, 1], [3, 0, 1, 1], [0, 0, 0, 0], [0, 0, 0, 7]], dtype=np.float32)
    np.testing.assert_array_equal(shrink_depth(depth, (2, 2)), [[2, 1], [0, 7]])
