from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm, logm
from scipy.spatial.transform import Rotation

from bask_data.core.trajectory import interpolated


def cross(w: np.ndarray) -> np.ndarray:
    return np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])


def steady(time: np.ndarray, spin: np.ndarray, speed: np.ndarray) -> np.ndarray:
    """A frame that turns at a constant rate, rad/s in its own axes, while its origin moves at a constant speed, m/s."""
    poses = np.tile(np.eye(4), (len(time), 1, 1))
    start = Rotation.from_rotvec([0.3, -1.0, 0.6]).as_matrix()
    for pose, t in zip(poses, time, strict=True):
        pose[:3, :3] = start @ expm(cross(spin) * t)
        pose[:3, 3] = np.array([0.2, 0.1, 0.8]) + speed * t
    return poses


def wandering(rng: np.random.Generator, n: int) -> np.ndarray:
    poses = np.tile(np.eye(4), (n, 1, 1))
    turns = Rotation.from_rotvec(rng.normal(size=(n, 3)) * 0.4)
    rotation = Rotation.random(rng=rng)
    for pose, turn in zip(poses, turns, strict=True):
        rotation = rotation * turn
        pose[:3, :3], pose[:3, 3] = rotation.as_matrix(), rng.normal(size=3)
    return poses


def one_by_one(
    time: np.ndarray, pose_time: np.ndarray, poses: np.ndarray, max_gap: float
) -> tuple[np.ndarray, np.ndarray]:
    """The same by its definition, with logarithm and exponential of matrices."""
    found, is_known = np.full((len(time), 4, 4), np.nan), np.zeros(len(time), bool)
    for i, t in enumerate(time):
        for j, begin in enumerate(pose_time):
            if t == begin:
                found[i], is_known[i] = poses[j], True
            elif j + 1 < len(pose_time) and begin < t < pose_time[j + 1] and pose_time[j + 1] - begin <= max_gap:
                share = (t - begin) / (pose_time[j + 1] - begin)
                turn = logm(poses[j, :3, :3].T @ poses[j + 1, :3, :3]).real
                found[i] = np.eye(4)
                found[i, :3, :3] = poses[j, :3, :3] @ expm(share * turn)
                found[i, :3, 3] = (1 - share) * poses[j, :3, 3] + share * poses[j + 1, :3, 3]
                is_known[i] = True
    return found, is_known


def test_a_steady_motion_is_met_between_its_poses() -> None:
    spin, speed = np.array([1.2, -2.0, 0.7]), np.array([0.3, -0.1, 0.05])
    pose_time = np.cumsum(np.random.default_rng(0).uniform(0.02, 0.3, 40))
    time = np.linspace(pose_time[0], pose_time[-1], 500)
    poses, is_known = interpolated(time, pose_time, steady(pose_time, spin, speed), max_gap=1.0)
    assert is_known.all()
    assert np.abs(poses - steady(time, spin, speed)).max() < 1e-12


@given(seed=st.integers(0, 10**6), n=st.integers(1, 9), max_gap=st.floats(0, 1))
def test_poses_and_what_is_known_of_them_follow_the_definition(seed: int, n: int, max_gap: float) -> None:
    rng = np.random.default_rng(seed)
    pose_time = np.cumsum(rng.uniform(0.05, 1.0, n))
    poses = wandering(rng, n)
    time = np.concatenate([rng.uniform(-0.5, pose_time[-1] + 0.5, 12), rng.choice(pose_time, 3), [np.nan]])
    expected, expected_known = one_by_one(time, pose_time, poses, max_gap)
    found, is_known = interpolated(time, pose_time, poses, max_gap)
    assert np.array_equal(is_known, expected_known)
    assert np.array_equal(np.isnan(found).any(axis=(1, 2)), ~expected_known)
    assert np.nanmax(np.abs(found - expected), initial=0) < 1e-9


def test_exact_hits_are_the_given_numbers_even_alone_and_beside_gaps() -> None:
    poses = wandering(np.random.default_rng(3), 3)
    pose_time = np.array([1.0, 11.0, 12.0])
    found, is_known = interpolated(np.array([11.0, 0.9, 1.0, 6.0, 12.0, 12.1]), pose_time, poses, max_gap=0.0)
    assert is_known.tolist() == [True, False, True, False, True, False]
    assert np.array_equal(found[is_known], poses[[1, 0, 2]])
    found, is_known = interpolated(np.array([5.0, 4.9]), np.array([5.0]), poses[:1], max_gap=1.0)
    assert is_known.tolist() == [True, False]
    assert np.array_equal(found[0], poses[0])


def test_nothing_is_known_without_poses() -> None:
    found, is_known = interpolated(np.array([0.0, 1.0]), np.zeros(0), np.zeros((0, 4, 4)), max_gap=1.0)
    assert not is_known.any()
    assert np.isnan(found).all()


def test_a_gap_as_long_as_allowed_is_allowed_on_the_clock_of_1970() -> None:
    pose_time = 1_700_000_000 + np.arange(50) / 10
    assert (np.diff(pose_time) > 0.1).any()
    poses = steady(np.arange(50) / 10, np.zeros(3), np.ones(3))
    assert interpolated(pose_time[:-1] + 0.03, pose_time, poses, max_gap=0.1)[1].all()
    assert not interpolated(pose_time[:-1] + 0.03, pose_time, poses, max_gap=0.0999)[1].any()


def test_poses_out_of_order_and_negative_gaps_are_refused() -> None:
    poses = np.tile(np.eye(4), (2, 1, 1))
    with pytest.raises(ValueError, match="pose_time: expected times that increase"):
        interpolated(np.zeros(1), np.array([1.0, 1.0]), poses, max_gap=1.0)
    with pytest.raises(ValueError, match="max_gap: expected at least 0 s, got -1"):
        interpolated(np.zeros(1), np.array([0.0, 1.0]), poses, max_gap=-1.0)
