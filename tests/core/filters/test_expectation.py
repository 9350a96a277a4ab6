from __future__ import annotations

import numpy as np
import pytest

from bask_data.core.filters.expectation import ExpectationSettings, expectation_step
from bask_data.core.filters.heatmap import softmax_map
from bask_data.core.filters.observation import Estimate, Observation
from bask_data.core.geometry import transform, unproject

K = np.array([[60.0, 0, 19.5], [0, 60.0, 14.5], [0, 0, 1]])


def bump(pixel: tuple[float, float], shape: tuple[int, int] = (30, 40), width: float = 2.0) -> np.ndarray:
    """Distances that are small around one pixel."""
    v, u = np.mgrid[: shape[0], : shape[1]]
    return (1 - np.exp(-((u - pixel[0]) ** 2 + (v - pixel[1]) ** 2) / (2 * width**2))).astype(np.float32)


def seen(distance: np.ndarray, depth: np.ndarray, world_from_camera: np.ndarray | None = None) -> Observation:
    return Observation(distance, depth, K, np.eye(4) if world_from_camera is None else world_from_camera)


def somewhere() -> np.ndarray:
    """A camera that is neither at the origin nor upright."""
    axis, angle = np.array([1.0, 2.0, -1.0]) / np.sqrt(6), 0.7
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    world_from_camera = np.eye(4)
    world_from_camera[:3, :3] = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    world_from_camera[:3, 3] = [0.3, -1.0, 2.0]
    return world_from_camera


def test_a_single_dip_is_found_in_the_world() -> None:
    world_from_camera = somewhere()
    depth = np.full((30, 40), 0.8, dtype=np.float32)
    distance = np.stack([bump((12, 9)), bump((30, 20))])
    _, estimate = expectation_step(None, [seen(distance, depth, world_from_camera)], settings=ExpectationSettings(50.0))
    uv = np.array([[12.0, 9.0], [30.0, 20.0]])
    expected = transform(world_from_camera, unproject(uv, np.full(2, 0.8), K))
    np.testing.assert_allclose(estimate.mean, expected, atol=1e-6)
    np.testing.assert_allclose(estimate.mode, expected, atol=1e-6)
    np.testing.assert_allclose(estimate.pixel[0], uv, atol=1e-6)
    assert estimate.observed.all()


def test_the_covariance_is_that_of_the_heat_on_the_surface() -> None:
    depth = np.full((30, 40), 0.8, dtype=np.float32)
    distance = bump((20, 14), width=3.0)[None]
    _, estimate = expectation_step(None, [seen(distance, depth)], settings=ExpectationSettings(9.0))
    heat, _ = softmax_map(distance, 9.0)
    v, u = np.mgrid[:30, :40].astype(np.float64)
    points = unproject(np.stack([u, v], -1), depth.astype(np.float64), K).reshape(-1, 3)
    expected = np.cov(points.T, aweights=heat.ravel(), ddof=0)
    np.testing.assert_allclose(estimate.covariance[0], expected + 1e-6 * np.eye(3), atol=1e-9)


def test_at_an_edge_the_depth_is_that_of_the_side_the_heat_is_on_and_never_between() -> None:
    depth = np.full((30, 40), 2.0, dtype=np.float32)
    depth[:, :20] = 0.5
    near = bump((18, 14), width=1.0)
    far = bump((22, 14), width=1.0)
    _, estimate = expectation_step(None, [seen(np.stack([near, far]), depth)], settings=ExpectationSettings(50.0))
    np.testing.assert_allclose(estimate.mean[:, 2], [0.5, 2.0])


def test_a_mean_that_falls_through_a_handle_gets_the_depth_of_the_handle() -> None:
    depth = np.full((30, 40), 2.0, dtype=np.float32)
    depth[:, 17:19] = depth[:, 22:24] = 0.5
    distance = np.ones((1, 30, 40), dtype=np.float32)
    distance[0, 14, [17, 18, 22, 23]] = 0.0
    _, estimate = expectation_step(None, [seen(distance, depth)], settings=ExpectationSettings(50.0))
    assert depth[14, round(estimate.pixel[0, 0, 0])] == 2.0
    np.testing.assert_allclose(estimate.mean[0, 2], 0.5)


def test_a_pixel_without_depth_borrows_it_from_its_neighbours() -> None:
    depth = np.full((30, 40), 0.7, dtype=np.float32)
    depth[12:17, 18:23] = 0
    depth[:, 30:] = 5.0
    _, estimate = expectation_step(None, [seen(bump((20, 14))[None], depth)], settings=ExpectationSettings(50.0))
    np.testing.assert_allclose(estimate.mean[0, 2], 0.7, rtol=1e-6)


def test_a_wide_hole_is_bridged_from_the_nearest_measurement() -> None:
    depth = np.zeros((30, 40), dtype=np.float32)
    depth[14, 5], depth[0, 39] = 0.6, 3.0
    _, estimate = expectation_step(None, [seen(bump((20, 14))[None], depth)], settings=ExpectationSettings(50.0))
    np.testing.assert_allclose(estimate.mean[0, 2], 0.6, rtol=1e-6)


def test_a_frame_without_any_depth_keeps_the_last_estimate() -> None:
    depth = np.full((30, 40), 0.8, dtype=np.float32)
    distance = bump((12, 9))[None]
    belief, first = expectation_step(None, [seen(distance, depth)])
    _, blind = expectation_step(None, [seen(distance, 0 * depth)])
    assert np.isnan(blind.mean).all()
    assert not blind.observed.any()
    _, kept = expectation_step(belief, [seen(distance, 0 * depth)])
    np.testing.assert_array_equal(kept.mean, first.mean)
    assert not kept.observed.any()


def test_two_cameras_are_fused_by_how_sure_each_is() -> None:
    depth = np.full((30, 40), 0.8, dtype=np.float32)
    sure, unsure = bump((20, 14), width=1.0)[None], bump((20, 14), width=6.0)[None]
    settings = ExpectationSettings(50.0)
    beside = np.eye(4)
    beside[0, 3] = 0.1
    _, alone = expectation_step(None, [seen(sure, depth)], settings=settings)
    _, both = expectation_step(None, [seen(sure, depth), seen(unsure, depth, beside)], settings=settings)
    assert abs(both.mean[0, 0] - alone.mean[0, 0]) < 0.02
    assert np.trace(both.covariance[0]) < np.trace(alone.covariance[0])
    assert both.pixel.shape == (2, 1, 2)


def test_distance_maps_coarser_than_depth_give_the_same_place() -> None:
    depth = np.full((60, 80), 0.8, dtype=np.float32)
    fine_k = np.array([[120.0, 0, 39.5], [0, 120.0, 29.5], [0, 0, 1]])
    coarse = Observation(bump((12, 9))[None], depth, fine_k, np.eye(4))
    _, estimate = expectation_step(None, [coarse], settings=ExpectationSettings(50.0))
    expected = unproject(np.array([24.5, 18.5]), np.array(0.8), fine_k)
    np.testing.assert_allclose(estimate.mean[0], expected, atol=1e-6)


def test_estimates_cannot_be_changed() -> None:
    _, estimate = expectation_step(None, [seen(bump((1, 1))[None], np.ones((30, 40), dtype=np.float32))])
    assert isinstance(estimate, Estimate)
    with pytest.raises(AttributeError):
        estimate.mean = estimate.mode  # type: ignore[misc]
