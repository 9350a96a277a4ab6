from __future__ import annotations

import numpy as np

from bask_data.evaluation.figures import plain
from bask_data.evaluation.lookup import spread_frames


def test_frames_are_spread_from_first_to_last():
    assert spread_frames(100, 3) == [0, 50, 99]
    assert spread_frames(2, 8) == [0, 1]
    assert spread_frames(0, 8) == []


def test_plain_values_are_json():
    assert plain({1: np.float32("nan"), "a": (np.int64(3), np.array([np.inf, 1.0]))}) == {
        "1": None,
        "a": [3, [None, 1.0]],
    }
