from __future__ import annotations

import numpy as np

from bask_data.core.visibility.decision import decided
from tests.two_boxes import (
    TOLERANCE,
)


def test_pixels_are_decided_by_the_table_of_the_docstring() -> None:
    label = np.full((1, 9), 1, np.uint8)
    rendered = np.full((1, 9), 0.5, np.float32)
    region = np.ones((1, 9), bool)
    cases = {0.5: 1, 0.512: 1, 0.3: 0, 0.9: 0, 0.0: 1}
    for measurement, expected in cases.items():
        depth = np.full((1, 9), measurement, np.float32)
        decision = decided(label, rendered, depth, region, TOLERANCE)
        assert (decision.label == expected).all(), measurement
        assert sum(decision.n_pixels.values()) == 9
        assert (decision.measured == (measurement > 0)).all()
    label[0, 5:], rendered[0, 5:] = 2, 0.8
    depth = np.full((1, 9), 0.8, np.float32)
    decision = decided(label, rendered, depth, region, TOLERANCE)
    assert decision.label[0].tolist() == [0, 0, 0, 2, 2, 2, 2, 2, 2], (
        "corrected within reach of the edge, removed beyond"
    )


def test_pixels_without_measurement_follow_the_measured_ones_around_them() -> None:
    label = np.full((40, 40), 1, np.uint8)
    rendered = np.full((40, 40), 0.5, np.float32)
    depth = np.zeros((40, 40), np.float32)
    depth[::3, :20:3], depth[::3, 20::3] = 0.2, 0.5
    decision = decided(label, rendered, depth, np.ones((40, 40), bool), TOLERANCE)
    assert not decision.label[:, :16].any()
    assert (decision.label[:, 24:] == 1).all()
    assert decision.n_pixels["not_measured_and_hidden"] > 300
    assert np.array_equal(decision.measured, depth > 0)
