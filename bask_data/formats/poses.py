"""Poses as files write them: matrices or quaternions, of either direction, in any unit and camera axes."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from bask_data.core.geometry import RIGID_TOLERANCE, invert_rigid, nearest_rigid, rigid_fault
from bask_data.errors import BadData
from bask_data.formats.files import Folder, numbers, read_lines
from bask_data.formats.options.common import PoseOptions

OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""Camera axes: y up and z backward become y down and z forward."""

QUATERNION_TOLERANCE = 0.01
"""Largest deviation from 1 of a quaternion's length. TUM's files have four digits, an error of 1e-4; other numbers
deviate far more."""

ROUNDED_TOLERANCE = 3e-3
"""Largest deviation of R^T R from the identity that three decimals leave, with the length of a column; the nearest
rotation is then less than 0.1 degrees away."""

METRES_PER_UNIT = {"m": 1.0, "cm": 0.01, "mm": 0.001}
"""Units of translations."""


def parse_transform(where: Path | str, values: list[float], quat: str = "xyzw") -> Float[ndarray, "4 4"]:
    """The transform in a pose file, as written: a 4x4 or 3x4 matrix, or tx ty tz and a quaternion.

    It may be not finite, where tracking was lost, and rounded; `rigid` and `prepare` check it.

    Args:
        quat: order of the quaternion, `xyzw` or `wxyz`.

    Raises:
        BadData: another count of numbers, or a quaternion whose length is not 1.
    """
    if len(values) == 7:
        return _from_quaternion(where, np.array(values), quat)
    if len(values) not in (12, 16):
        raise BadData(
            where,
            "pose",
            expected="a 4x4 or 3x4 matrix or tx ty tz qx qy qz qw",
            got=f"{len(values)} numbers",
            fix="check the file, and the option that names it.",
        )
    matrix = np.eye(4)
    matrix[: len(values) // 4] = np.array(values).reshape(-1, 4)
    return matrix


def parse_pose(where: Path | str, values: list[float], quat: str = "xyzw") -> Float[ndarray, "4 4"]:
    """As `parse_transform`, made exactly rigid; `BadData` if it is not, beyond rounding."""
    return rigid(where, parse_transform(where, values, quat))


def read_pose(path: Path, quat: str = "xyzw") -> Float[ndarray, "4 4"]:
    """The one rigid transform in a text file; `BadData` if there is none."""
    return parse_pose(path, [value for line in read_lines(path) for value in numbers(path, line)], quat)


def read_transforms(paths: list[Path], quat: str = "xyzw") -> Float[ndarray, "t 4 4"]:
    """One transform per file, as written."""
    return np.stack(
        [parse_transform(path, [v for line in read_lines(path) for v in numbers(path, line)], quat) for path in paths]
    )


def rigid(where: Path | str, matrix: Float[ndarray, "4 4"]) -> Float[ndarray, "4 4"]:
    """The exactly rigid transform nearest to `matrix`; `BadData` if it deviates by more than rounding."""
    if fault := rigid_fault(matrix, ROUNDED_TOLERANCE):
        raise BadData(where, "pose", expected="a rigid transform", got=fault, fix="write it as a rotation and metres.")
    return nearest_rigid(matrix)


def is_rounded(matrix: Float[ndarray, "4 4"]) -> bool:
    """Whether a rigid transform is rounded so far that users should know."""
    return bool(rigid_fault(matrix, RIGID_TOLERANCE))


def to_world_from_camera(
    poses: Float[ndarray, "t 4 4"],
    options: PoseOptions,
    *,
    folder: Folder | None = None,
) -> tuple[Float[ndarray, "t 4 4"], Float[ndarray, "t 4 4"] | None, tuple[Path, ...]]:
    """Poses as written, in our convention.

    Args:
        poses: transforms as the options say; may hold NaN.
        folder: where `--gripper-from-camera` is looked for, after the current folder.

    Returns:
        world_from_camera of OpenCV cameras, metres; world_from_gripper if the poses are a gripper's; files used.
    """
    world_from_any = poses.copy()
    world_from_any[:, :3, 3] *= METRES_PER_UNIT[options.pose_unit]
    if options.pose_is == "camera_from_world":
        world_from_any = invert_rigid(world_from_any)
    if not options.gripper_from_camera:
        return _in_opencv(world_from_any, options.axes), None, ()
    path = Path(options.gripper_from_camera)
    if not path.is_file() and folder is not None:
        path = folder.member(options.gripper_from_camera, "--gripper-from-camera")
    gripper_from_camera = read_pose(path, options.quat)
    return _in_opencv(world_from_any @ gripper_from_camera, options.axes), world_from_any, (path,)


def other_readings(
    poses: Float[ndarray, "t 4 4"], options: PoseOptions, *, folder: Folder | None = None
) -> dict[str, Float[ndarray, "t 4 4"]]:
    """The poses under the other directions and axes, by the options for them."""
    directions: tuple[Literal["world_from_camera", "camera_from_world"], ...] = (
        "world_from_camera",
        "camera_from_world",
    )
    axes: tuple[Literal["opencv", "opengl"], ...] = ("opencv", "opengl")
    return {
        f"--pose-is {pose_is} --axes {axis}": to_world_from_camera(
            poses, options.model_copy(update={"pose_is": pose_is, "axes": axis}), folder=folder
        )[0]
        for pose_is in directions
        for axis in axes
        if (pose_is, axis) != (options.pose_is, options.axes)
    }


def _in_opencv(world_from_camera: Float[ndarray, "t 4 4"], axes: str) -> Float[ndarray, "t 4 4"]:
    return world_from_camera * np.diag(OPENCV_FROM_OPENGL) if axes == "opengl" else world_from_camera


def _from_quaternion(where: Path | str, values: Float[ndarray, "7"], quat: str) -> Float[ndarray, "4 4"]:
    quat_xyzw = values[3:] if quat == "xyzw" else np.roll(values[3:], -1)
    length = float(np.linalg.norm(quat_xyzw))
    if not np.isfinite(values).all() or length == 0:
        return np.full((4, 4), np.nan)
    if not abs(length - 1) <= QUATERNION_TOLERANCE:
        raise BadData(
            where,
            "pose",
            expected="a quaternion of length 1",
            got=f"length {length:.4g}",
            fix="write each line as tx ty tz qx qy qz qw.",
        )
    x, y, z, w = quat_xyzw / length
    matrix = np.eye(4)
    matrix[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    matrix[:3, 3] = values[:3]
    return matrix
