from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial.transform import Rotation

from bask_data.core.geometry import rotation_angle
from bask_data.core.similarity import similarity


def cameras(n: int, seed: int, straight: bool = False) -> Float[ndarray, "n 4 4"]:
    rng = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (n, 1, 1))
    poses[:, :3, :3] = Rotation.random(n, rng).as_matrix()
    poses[:, :3, 3] = np.outer(np.linspace(0, 1, n), [1, 2, 3]) if straight else rng.normal(size=(n, 3))
    return poses


def moved(a_from_cameras: Float[ndarray, "n 4 4"], scale: float, seed: int = 9) -> Float[ndarray, "n 4 4"]:
    b_from_a = cameras(1, seed)[0]
    scaled = a_from_cameras.copy()
    scaled[:, :3, 3] *= scale
    return b_from_a @ scaled


@settings(max_examples=20, deadline=None)
@given(st.integers(3, 12), st.integers(0, 1000), st.floats(0.01, 100), st.booleans())
def test_similarity_is_recovered_even_from_a_straight_path(n: int, seed: int, scale: float, straight: bool) -> None:
    ours = cameras(n, seed, straight)
    fit = similarity(ours, moved(ours, scale))
    assert fit.scale == pytest.approx(scale, rel=1e-9)
    assert fit.moved(ours) == pytest.approx(moved(ours, scale), rel=1e-9, abs=1e-9 * max(1, scale))
    assert fit.inliers.all()


def test_wrong_poses_are_rejected_and_change_nothing() -> None:
    ours = cameras(20, 0)
    theirs = moved(ours, 0.1)
    theirs[[1, 5, 6, 13, 17]] = cameras(5, 3)
    fit = similarity(ours, theirs)
    assert np.flatnonzero(~fit.inliers).tolist() == [1, 5, 6, 13, 17]
    assert fit.scale == pytest.approx(0.1, rel=1e-9)


def test_noise_of_many_poses_averages_out() -> None:
    rng = np.random.default_rng(1)
    ours = cameras(400, 0)
    theirs = moved(ours, 0.5)
    theirs[:, :3, 3] += rng.normal(0, 0.01, (400, 3))
    theirs[:, :3, :3] = theirs[:, :3, :3] @ Rotation.from_rotvec(rng.normal(0, 0.02, (400, 3))).as_matrix()
    fit = similarity(ours, theirs)
    exact = moved(ours, 0.5)
    assert fit.scale == pytest.approx(0.5, rel=2e-3)
    assert rotation_angle(fit.moved(ours)[0, :3, :3].T @ exact[0, :3, :3]) < 0.004
    assert np.linalg.norm(fit.moved(ours)[:, :3, 3] - exact[:, :3, 3], axis=1).max() < 0.01
    assert fit.inliers.mean() > 0.9


def test_scale_that_is_known_is_kept() -> None:
    ours = cameras(6, 0)
    fit = similarity(ours, moved(ours, 1.02), scale=1.0)
    assert fit.scale == 1.0
    assert np.linalg.norm(fit.moved(ours)[:, :3, 3] - moved(ours, 1.02)[:, :3, 3], axis=1).max() < 0.1


@pytest.mark.parametrize("poses", [cameras(2, 0), np.tile(np.eye(4), (5, 1, 1)), np.zeros((0, 4, 4))])
def test_too_few_places_are_refused(poses: Float[ndarray, "n 4 4"]) -> None:
    with pytest.raises(ValueError, match="expected three cameras or more in different places"):
        similarity(poses, poses)
