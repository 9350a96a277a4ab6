from __future__ import annotations

import numpy as np

from bask_data.core.geometry import rotation_angle
from bask_data.formats.object_poses import static_pose, static_poses
from tests.formats.folders import rigid

POSE = rigid(np.random.default_rng(0))


def scattered(n: int, metres: float) -> np.ndarray:
    poses = np.tile(POSE, (n, 1, 1))
    poses[:, :3, 3] += np.random.default_rng(1).normal(size=(n, 3)) * metres
    return poses


def test_the_pose_is_in_the_middle_of_the_annotations_and_its_error_their_spread() -> None:
    poses = scattered(300, 0.001)
    pose = static_pose(poses)
    assert np.linalg.norm(pose.world_from_object[:3, 3] - POSE[:3, 3]) < 3e-4
    distance = np.linalg.norm(poses[:, :3, 3] - pose.world_from_object[:3, 3], axis=1)
    assert (distance <= pose.error).mean() == 0.95


def test_a_symmetric_object_annotated_in_two_ways_gets_one_of_them() -> None:
    poses = scattered(9, 0.0)
    poses[:4, :3, :2] *= -1
    chosen = static_pose(poses).world_from_object
    assert rotation_angle((chosen[:3, :3].T @ POSE[:3, :3])[None])[0] < 1e-6


def test_an_object_that_moves_has_no_pose() -> None:
    poses, moving = static_poses({1: list(scattered(9, 0.001)), 2: list(scattered(9, 0.1)), 3: []})
    assert set(poses) == {1} and moving == [2]
