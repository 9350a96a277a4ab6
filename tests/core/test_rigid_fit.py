from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bask_data.core.geometry import rigid_fault, transform
from bask_data.core.rigid_fit import rigid_fit, robust_rigid_fit


def motion(rng: np.random.Generator) -> np.ndarray:
    rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    rotation[:, 0] *= np.linalg.det(rotation)
    b_from_a = np.eye(4)
    b_from_a[:3, :3], b_from_a[:3, 3] = rotation, rng.normal(size=3)
    return b_from_a


@given(st.integers(0, 2**32 - 1), st.integers(3, 20), st.booleans())
def test_the_motion_of_points_is_recovered_also_of_flat_ones(seed, k, is_flat):
    rng = np.random.default_rng(seed)
    b_from_a, points = motion(rng), rng.normal(size=(k, 3))
    if is_flat:
        points[:, 2] = 0.0
    found = rigid_fit(points, transform(b_from_a, points))
    assert rigid_fault(found) == ""
    np.testing.assert_allclose(transform(found, points), transform(b_from_a, points), atol=1e-6)


def test_a_mirror_image_is_fitted_by_a_rotation():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(10, 3))
    assert rigid_fault(rigid_fit(points, points * [-1, 1, 1])) == ""


def test_a_third_of_right_correspondences_decides():
    rng = np.random.default_rng(3)
    b_from_a, points = motion(rng), 0.1 * rng.normal(size=(30, 3))
    partners = transform(b_from_a, points) + 0.001 * rng.normal(size=(30, 3))
    partners[10:] = rng.uniform(-1, 1, size=(20, 3))
    found, inliers = robust_rigid_fit(points, partners, 0.01, rng)
    assert inliers[:10].all()
    np.testing.assert_allclose(transform(found, points), transform(b_from_a, points), atol=0.01)


def test_scattered_partners_have_few_inliers():
    rng = np.random.default_rng(4)
    points, partners = 0.1 * rng.normal(size=(30, 3)), rng.uniform(-1, 1, size=(30, 3))
    assert robust_rigid_fit(points, partners, 0.01, rng)[1].sum() < 5
    far_apart = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    assert robust_rigid_fit(far_apart, 5 * far_apart, 0.01, rng)[1].sum() == 0


def test_two_points_are_refused():
    with pytest.raises(ValueError, match="points: expected at least 3, got 2"):
        robust_rigid_fit(np.zeros((2, 3)), np.zeros((2, 3)), 0.01, np.random.default_rng(0))
