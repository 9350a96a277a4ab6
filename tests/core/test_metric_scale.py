from __future__ import annotations

import numpy as np
import pytest

from bask_data.core.metric_scale import LEAST_RATIOS, depth_log_ratios, metric_scale


def test_ratio_is_taken_where_depth_is_flat_and_measured() -> None:
    depth = np.full((40, 60), 2.0)
    depth[:, 30:] = 2.5
    depth[20:] = 0
    uv = np.array([[10.0, 10.0], [28.6, 10.0], [31.0, 10.0], [50.2, 9.7], [10.0, 30.0], [10.0, 20.0], [-3.0, 5.0]])
    uv = np.vstack([uv, [[np.nan, np.nan]]])
    ratios = depth_log_ratios(uv, np.full(len(uv), 4.0), depth)
    # The first, the fourth, and the sixth at the border of what is measured; edges, holes and the outside are not.
    assert np.exp(ratios) == pytest.approx([0.5, 0.625, 0.5])


def test_points_behind_the_camera_and_images_without_depth_give_nothing() -> None:
    uv = np.array([[5.0, 5.0]])
    assert len(depth_log_ratios(uv, np.array([-1.0]), np.full((10, 10), 2.0))) == 0
    assert len(depth_log_ratios(uv, np.array([1.0]), np.zeros((10, 10)))) == 0
    assert len(depth_log_ratios(np.zeros((0, 2)), np.zeros(0), np.ones((10, 10)))) == 0


def test_scale_is_the_median_of_images_and_its_spread_is_stated() -> None:
    rng = np.random.default_rng(0)
    images = [np.log(0.03) + rng.normal(0, 0.01) + rng.normal(0, 0.05, 200) for _ in range(300)]
    images[:60] = [ratios + 1.0 for ratios in images[:60]]  # Images of another scene.
    few = [np.full(LEAST_RATIOS - 1, 5.0)]
    scale = metric_scale(images[50:] + few)
    assert scale is not None
    assert scale.metres_per_unit == pytest.approx(0.03, rel=0.003)
    assert scale.spread == pytest.approx(0.011, rel=0.2)
    assert scale.point_spread == pytest.approx(0.05, rel=0.05)
    assert (scale.n_images, scale.n_points) == (250, 50000)
    assert metric_scale(few) is None


def test_steep_plane_counts_and_a_step_on_it_does_not() -> None:
    across = np.arange(60.0)
    depth = np.tile(1.0 + 0.01 * across, (40, 1))
    depth[:, 40:] += 0.1
    uv = np.array([[20.0, 20.0], [40.0, 20.0], [50.0, 20.0]])
    ratios = depth_log_ratios(uv, np.array([1.2, 1.5, 1.6]), depth)
    assert np.exp(ratios) == pytest.approx([1.0, 1.0])
