from __future__ import annotations

import numpy as np
import pytest

from bask_data.core.static_truth import Visibility, visibility

K = np.array([[100.0, 0, 50], [0, 100.0, 40], [0, 0, 1]])


def test_points_are_seen_hidden_or_out_of_view_by_the_measured_depth() -> None:
    depth = np.full((81, 101), 1.0, dtype=np.float32)
    depth[:, :20] = 0
    depth[:, 80:] = 3.0
    points = np.array([[0, 0, 1.0], [0, 0, 1.01], [0, 0, 1.2], [0, 0, -1], [2, 0, 1], [-0.45, 0, 1], [0.45, 0, 1]])
    world_from_camera = np.eye(4)
    world_from_camera[:3, 3] = [5, 6, 7]
    seen = visibility(points + np.array([5, 6, 7]), depth, K, world_from_camera, tolerance=0.02)
    expected = ["VISIBLE", "VISIBLE", "OCCLUDED", "OUT_OF_VIEW", "OUT_OF_VIEW", "UNKNOWN", "UNKNOWN"]
    assert [Visibility(int(one)).name for one in seen] == expected


def test_a_negative_tolerance_is_refused() -> None:
    with pytest.raises(ValueError, match="tolerance: expected >= 0 metres, got -1"):
        visibility(np.zeros((1, 3)), np.ones((2, 2), dtype=np.float32), K, np.eye(4), tolerance=-1.0)
