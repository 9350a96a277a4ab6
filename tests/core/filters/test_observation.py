from __future__ import annotations

import numpy as np

from bask_data.core.filters.observation import Observation, pixels_of

K = np.array([[60.0, 0, 19.5], [0, 60.0, 14.5], [0, 0, 1]])


def test_pixels_of_points_behind_the_camera_are_nan() -> None:
    observation = Observation(
        np.zeros((1, 30, 40), dtype=np.float32), np.ones((30, 40), dtype=np.float32), K, np.eye(4)
    )
    uv = pixels_of(np.array([[0.0, 0, 1], [0, 0, -1]]), observation)
    np.testing.assert_allclose(uv[0], [19.5, 14.5])
    assert np.isnan(uv[1]).all()
