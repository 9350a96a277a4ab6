from __future__ import annotations

import numpy as np
import pytest

from bask_data.core.geometry import invert_rigid, rotation_angle
from bask_data.sim.defects import depth_edges, grazing, holes, measured, noisy_poses, stored, with_flying_pixels
from bask_data.sim.options import SimOptions
from bask_data.sim.rendering import RenderedView, intrinsics

H, W = 240, 320
K = intrinsics(56.0, H, W)


def view_of(depth: np.ndarray, glass: np.ndarray | None = None) -> RenderedView:
    shape = depth.shape
    is_glass = np.zeros(shape, dtype=bool) if glass is None else glass
    return RenderedView(
        np.zeros((*shape, 3), dtype=np.uint8), depth.astype(np.float32), np.zeros(shape, np.uint8), is_glass, np.eye(4)
    )


def wall(z: float) -> np.ndarray:
    return np.full((H, W), z, dtype=np.float32)


def step(near: float = 0.5, far: float = 0.8) -> np.ndarray:
    depth = wall(far)
    depth[:, : W // 2] = near
    return depth


def options(**values: object) -> SimOptions:
    return SimOptions(task="lid", **{"depth_noise": 0.0, **values})  # type: ignore[arg-type]


def test_without_defects_depth_is_exact() -> None:
    depth = step()
    depth[:10] = 0
    np.testing.assert_array_equal(measured(view_of(depth), K, options(), np.random.default_rng(0)), depth)


@pytest.mark.parametrize(("z", "noise"), [(0.5, 0.005), (1.5, 0.005), (0.5, 0.02)])
def test_noise_is_unbiased_and_has_the_requested_size(z: float, noise: float) -> None:
    error = measured(view_of(wall(z)), K, options(depth_noise=noise), np.random.default_rng(0)) - np.float32(z)
    sigma = 0.001 + noise * z
    assert error.std() == pytest.approx(sigma, rel=0.02)
    assert abs(error.mean()) < 4 * sigma / np.sqrt(error.size)
    # The noise of neighbouring pixels is independent.
    assert abs(np.corrcoef(error[:, 1:].ravel(), error[:, :-1].ravel())[0, 1]) < 0.02


def test_noise_neither_adds_nor_removes_measurements() -> None:
    depth = wall(0.002)
    depth[:, ::2] = 0
    noisy = measured(view_of(depth), K, options(depth_noise=0.02), np.random.default_rng(0))
    assert ((noisy > 0) == (depth > 0)).all()
    assert ((stored(noisy) > 0) == (depth > 0)).all()


def test_flying_pixels_are_between_foreground_and_background_and_only_at_edges() -> None:
    depth = step()
    flown = with_flying_pixels(depth, 0.4, np.random.default_rng(0))
    edges, _, _ = depth_edges(depth)
    assert (np.flatnonzero(edges.any(axis=0)) == [W // 2 - 1, W // 2]).all()
    changed = flown != depth
    assert not changed[~edges].any()
    assert changed[edges].mean() == pytest.approx(0.4, abs=0.06)
    assert (flown[changed] > 0.5).all() and (flown[changed] < 0.8).all()
    assert flown[changed].std() == pytest.approx(0.3 / np.sqrt(12), rel=0.2)


def test_edges_to_pixels_without_depth_have_no_flying_pixels() -> None:
    depth = wall(0.5)
    depth[:, W // 2 :] = 0
    np.testing.assert_array_equal(with_flying_pixels(depth, 1.0, np.random.default_rng(0)), depth)


def test_holes_have_the_requested_share_in_patches() -> None:
    hole = holes(view_of(wall(0.6)), K, 0.1, np.random.default_rng(0))
    assert hole.mean() == pytest.approx(0.1, abs=0.001)
    # Next to a missing pixel, another is missing far more often than one in ten.
    assert hole[:, 1:][hole[:, :-1]].mean() > 0.7


def test_glass_and_grazed_surfaces_have_more_holes() -> None:
    glass = np.zeros((H, W), dtype=bool)
    glass[60:120, 80:200] = True
    hole = holes(view_of(wall(0.6), glass), K, 0.1, np.random.default_rng(0))
    assert hole[glass].mean() > 4 * hole[~glass].mean()
    # A plane 12 degrees from edge-on in the left half, facing the camera in the right.
    _, u = np.mgrid[:H, :W]
    slanted = 0.4 / (1 + (u - K[0, 2]) / K[0, 0] * np.tan(np.radians(78.0)) * -1).clip(0.3)
    depth = np.where(u < W // 2, slanted, 0.6)
    hole = holes(view_of(depth), K, 0.1, np.random.default_rng(0))
    assert hole[:, : W // 2].mean() > 1.5 * hole[:, W // 2 :].mean()


def test_an_image_without_depth_has_no_holes() -> None:
    assert not holes(view_of(wall(0.0)), K, 0.5, np.random.default_rng(0)).any()


def test_grazing_is_one_minus_the_cosine_of_the_viewing_angle_even_beside_edges() -> None:
    v, u = np.mgrid[:H, :W]
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones((H, W))], axis=-1)
    normal = np.array([0.3, -0.5, -0.81])
    normal /= np.linalg.norm(normal)
    depth = (normal @ [0, 0, 0.6]) / (rays @ normal)
    depth[:, W // 2 :] += 0.2  # parallel, and behind
    expected = 1 - np.abs(rays @ normal) / np.linalg.norm(rays, axis=-1)
    left = np.s_[1:-1, 1 : W // 2]
    np.testing.assert_allclose(grazing(depth.astype(np.float32), K)[left], expected[left], atol=0.02)


def test_pose_noise_is_two_millimetres_and_a_fifth_of_a_degree_times_the_factor() -> None:
    exact = np.tile(np.eye(4), (4000, 1, 1))
    exact[:, :3, 3] = [0.1, 0.2, 0.3]
    noisy = noisy_poses(exact, 2.0, False, np.random.default_rng(0))
    off = invert_rigid(exact) @ noisy
    assert off[:, :3, 3].std() == pytest.approx(0.004, rel=0.05)
    # 0.4 degrees about each axis: the angle is the length of such a rotation vector.
    angles = np.degrees(rotation_angle(off[:, :3, :3]))
    assert np.sqrt((angles**2).mean() / 3) == pytest.approx(0.4, rel=0.05)
    assert np.abs(off[:, :3, :3] @ off[:, :3, :3].transpose(0, 2, 1) - np.eye(3)).max() < 1e-12


def test_a_fixed_cameras_error_is_constant_and_zero_noise_changes_nothing() -> None:
    exact = np.tile(np.eye(4), (5, 1, 1))
    noisy = noisy_poses(exact, 1.0, True, np.random.default_rng(0))
    assert (noisy == noisy[0]).all()
    assert not np.allclose(noisy, exact)
    np.testing.assert_array_equal(noisy_poses(exact, 0.0, False, np.random.default_rng(0)), exact)


def test_depth_is_stored_in_tenths_of_millimetres_within_16_bits() -> None:
    depth = np.array([[0.0, 0.00004, 0.00006, 0.12344, 6.5535, 6.5536, 7.9]], dtype=np.float32)
    assert stored(depth).tolist() == [[0, 0, 1, 1234, 65535, 0, 0]]
