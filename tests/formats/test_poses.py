from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from bask_data.core.geometry import invert_rigid
from bask_data.errors import BadData
from bask_data.formats import poses
from bask_data.formats.files import Folder
from bask_data.formats.options.common import PoseOptions
from tests.formats.folders import rigid


@given(st.integers(0, 10**6))
def test_a_pose_reads_the_same_as_matrix_of_four_or_three_rows_and_as_quaternion(seed: int) -> None:
    matrix = rigid(np.random.default_rng(seed))
    quat_xyzw = Rotation.from_matrix(matrix[:3, :3]).as_quat()
    for values in (matrix.ravel(), matrix[:3].ravel(), np.r_[matrix[:3, 3], quat_xyzw]):
        assert np.allclose(poses.parse_pose("pose.txt", values.tolist()), matrix, atol=1e-12)


@given(st.integers(0, 10**6))
def test_rounded_poses_are_made_exactly_rigid(seed: int) -> None:
    rounded = np.round(rigid(np.random.default_rng(seed)), 4)
    rotation = poses.parse_pose("pose.txt", rounded.ravel().tolist())[:3, :3]
    assert np.allclose(rotation.T @ rotation, np.eye(3), atol=1e-14)


FAULTS = {
    "a mirrored frame": np.diag([1.0, 1, -1, 1]),
    "a scaled frame": np.diag([2.0, 2, 2, 1]),
    "a value that is not finite": np.diag([1.0, 1, np.nan, 1]),
    "axes that are not perpendicular": np.array([[1, 0.8, 0, 0], [0, 0.6, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]]),
    "last row": np.eye(4).T + np.diag([0, 0, 0, 1.0]),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_pose_that_is_not_rigid_is_refused_with_its_fault(fault: str) -> None:
    with pytest.raises(BadData, match=f"pose.txt: pose: expected a rigid transform, got {fault}.*fix: "):
        poses.parse_pose("pose.txt", FAULTS[fault].ravel().tolist())


def test_a_pose_of_another_count_of_numbers_is_refused() -> None:
    with pytest.raises(BadData, match="pose: expected a 4x4 or 3x4 matrix or tx ty tz qx qy qz qw, got 6 numbers"):
        poses.parse_pose("pose.txt", [0.0] * 6)


def test_a_quaternion_without_unit_length_is_refused() -> None:
    with pytest.raises(BadData, match="expected a quaternion of length 1, got length"):
        poses.parse_pose("pose.txt", [0.0, 0.0, 0.0, 1.0, 1.0, 0.0, 0.0])


@pytest.mark.parametrize("quaternion", [[0.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, float("nan")]])
def test_a_quaternion_of_zeros_or_nan_is_a_lost_pose(quaternion: list[float]) -> None:
    assert np.isnan(poses.parse_transform("pose.txt", [0.0, 0.0, 0.0, *quaternion])).all()


@given(st.integers(0, 10**6))
def test_poses_of_either_direction_axes_unit_and_quaternion_order_read_the_same(seed: int) -> None:
    matrix = rigid(np.random.default_rng(seed))
    for pose_is in ("world_from_camera", "camera_from_world"):
        for axes in ("opencv", "opengl"):
            written = matrix @ np.diag([1.0, -1, -1, 1]) if axes == "opengl" else matrix
            written = invert_rigid(written) if pose_is == "camera_from_world" else written.copy()
            written[:3, 3] *= 1000
            quat_wxyz = np.roll(Rotation.from_matrix(written[:3, :3]).as_quat(), 1)
            read = poses.parse_transform("pose.txt", [*written[:3, 3], *quat_wxyz], "wxyz")
            options = PoseOptions(pose_is=pose_is, axes=axes, pose_unit="mm", quat="wxyz")
            world_from_camera, gripper, files = poses.to_world_from_camera(read[None], options)
            assert np.allclose(world_from_camera[0], matrix, atol=1e-9)
            assert gripper is None and files == ()


def test_a_hand_eye_calibration_makes_poses_those_of_the_gripper(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    world_from_gripper, gripper_from_camera = rigid(rng), rigid(rng)
    np.savetxt(tmp_path / "hand_eye.txt", gripper_from_camera)
    options = PoseOptions(gripper_from_camera="hand_eye.txt")
    world_from_camera, gripper, files = poses.to_world_from_camera(
        world_from_gripper[None], options, folder=Folder(tmp_path)
    )
    assert np.allclose(world_from_camera[0], world_from_gripper @ gripper_from_camera, atol=1e-12)
    assert gripper is not None and np.array_equal(gripper[0], world_from_gripper)
    assert files == (tmp_path / "hand_eye.txt",)


def test_a_hand_eye_calibration_is_also_read_the_other_way(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    world_from_gripper, gripper_from_camera = rigid(rng), rigid(rng)
    np.savetxt(tmp_path / "hand_eye.txt", invert_rigid(gripper_from_camera))
    flip = np.diag([1.0, -1, -1, 1])
    for axes, turn in (("opencv", np.eye(4)), ("opengl", flip)):
        options = PoseOptions(gripper_from_camera="hand_eye.txt", axes=axes, pose_is="camera_from_world")
        readings = poses.other_readings(invert_rigid(world_from_gripper)[None], options, folder=Folder(tmp_path))
        found = readings["the inverse of --gripper-from-camera"][0]
        assert np.allclose(found, world_from_gripper @ gripper_from_camera @ turn, atol=1e-9)
    assert "the inverse of --gripper-from-camera" not in poses.other_readings(world_from_gripper[None], PoseOptions())
