from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from bask_data.core.geometry import pixel_grid, unproject
from bask_data.core.visibility.surface import CameraDirections, ray_directions

HEIGHT, WIDTH = 12, 16
NUMBER = st.floats(-1e3, 1e3)
K = np.array([[20.0, 0, 7.5], [0, 21, 5.5], [0, 0, 1]])


@given(st.tuples(st.floats(1, 1e4), st.floats(1, 1e4)), st.tuples(NUMBER, NUMBER), NUMBER)
def test_directions_are_the_pixels_at_depth_one(
    focal: tuple[float, float], centre: tuple[float, float], skew: float
) -> None:
    camera = np.array([[focal[0], skew, centre[0]], [0, focal[1], centre[1]], [0, 0, 1]])
    expected = unproject(pixel_grid(HEIGHT, WIDTH), np.ones((HEIGHT, WIDTH)), camera).astype(np.float32)
    np.testing.assert_array_equal(ray_directions(camera, HEIGHT, WIDTH), expected)


def test_directions_are_computed_again_only_where_intrinsics_change() -> None:
    Ks = np.stack([K, K, K, K])
    Ks[2, 0, 2] += 3
    directions = CameraDirections(Ks, HEIGHT, WIDTH)
    first = directions[0]
    assert directions[1] is first
    for i_frame in (2, 3, 2):
        np.testing.assert_array_equal(directions[i_frame], ray_directions(Ks[i_frame], HEIGHT, WIDTH))
