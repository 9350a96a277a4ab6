"""Poses as files write them: matrices or quaternions, of either direction, in any unit and camera axes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import product
from pathlib import Path
from typing import get_args

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial.transform import Rotation

from bask_data.core.geometry import RIGID_TOLERANCE, invert_rigid, nearest_rigid, rigid_fault
from bask_data.errors import BadData
from bask_data.formats.arrays import read_npy
from bask_data.formats.files import Folder, numbers, read_lines
from bask_data.formats.options.common import Axes, PoseIs, PoseOptions

OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""Camera axes: y up and z backward become y down and z forward."""

QUATERNION_TOLERANCE = 0.01
"""Largest deviation from 1 of a quaternion's length. TUM's files have four digits, an error of 1e-4; other numbers
deviate far more."""

ROUNDED_TOLERANCE = 3e-3
"""Largest deviation of R^T R from the identity that three decimals leave, with the length of a column; the nearest
rotation is then less than 0.1 degrees away."""

METRES_PER_UNIT = {"m": 1.0, "cm": 0.01, "mm": 0.001}
"""Units of lengths."""

LENGTH_NAMES = {"m": "metres", "cm": "centimetres", "mm": "millimetres"}
"""Units of lengths, in words."""


def parse_transform(
    where: Path | str, values: list[float], quat: str = "xyzw", column_major: bool = False
) -> Float[ndarray, "4 4"]:
    """The transform in a pose file, as written: a 4x4 or 3x4 matrix, or tx ty tz and a quaternion.

    It may be not finite, where tracking was lost, and rounded; `rigid` and `prepare` check it.

    Args:
        quat: order of the quaternion, `xyzw` or `wxyz`.
        column_major: whether a matrix is written column by column.

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
    n_rows = len(values) // 4
    written = np.array(values, dtype=np.float64)
    matrix[:n_rows] = written.reshape(4, n_rows).T if column_major else written.reshape(n_rows, 4)
    return matrix


def parse_pose(where: Path | str, values: list[float], quat: str = "xyzw") -> Float[ndarray, "4 4"]:
    """As `parse_transform`, made exactly rigid; `BadData` if it is not, beyond rounding."""
    return rigid(where, parse_transform(where, values, quat))


def read_pose(path: Path, quat: str = "xyzw") -> Float[ndarray, "4 4"]:
    """The one rigid transform in a text file; `BadData` if there is none."""
    return parse_pose(path, pose_values(path), quat)


def read_transforms(paths: Sequence[Path | None]) -> Float[ndarray, "t 4 4"]:
    """One transform per file, as written; NaN where there is no file."""
    unknown = np.full((4, 4), np.nan)
    return np.stack([unknown if path is None else parse_transform(path, pose_values(path)) for path in paths])


def pose_values(path: Path) -> list[float]:
    """The numbers in a pose file: text, or an array of NumPy."""
    if path.suffix.lower() == ".npy":
        return [float(value) for value in read_npy(path, 16).ravel()]
    return [value for line in read_lines(path) for value in numbers(path, line)]


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
    gripper_from_camera, path = _hand_eye(options, folder)
    return _in_opencv(world_from_any @ gripper_from_camera, options.axes), world_from_any, (path,)


def _hand_eye(options: PoseOptions, folder: Folder | None) -> tuple[Float[ndarray, "4 4"], Path]:
    """The calibration in `--gripper-from-camera`, and its file."""
    path = Path(options.gripper_from_camera)
    if not path.is_file() and folder is not None:
        path = folder.member(options.gripper_from_camera, "--gripper-from-camera")
    return read_pose(path, options.quat), path


def refuse_transposed(poses: Float[ndarray, "t 4 4"], places: Sequence[str], column_major: bool) -> None:
    """Refuse matrices that are rigid transforms only if they are written the other way round; `BadData`."""
    for pose, place in zip(poses, places, strict=True):
        if rigid_fault(pose, ROUNDED_TOLERANCE) and any(
            not rigid_fault(other, ROUNDED_TOLERANCE) for other in _written_otherwise(pose)
        ):
            order, other = ("row by row", "column by column")[:: -1 if column_major else 1]
            raise BadData(
                place,
                "pose",
                expected=f"a rigid transform written {other if column_major else order}",
                got="one that is transposed" + ("" if column_major else ": column-major, its translation last"),
                fix="leave out --column-major." if column_major else "pass --column-major.",
            )


def _written_otherwise(pose: Float[ndarray, "4 4"]) -> Iterator[Float[ndarray, "4 4"]]:
    """The matrix if its 16 numbers, or its first 12, are written in the other order."""
    yield pose.T
    twelve = np.eye(4)
    twelve[:3] = pose[:3].reshape(4, 3).T
    yield twelve
    twelve[:3] = pose[:3].T.reshape(3, 4)
    yield twelve


FAR_APART = 5.0
"""Metres between cameras above which poses may be in a smaller unit: a scan of a table spans one or two. It only
decides whether other units are compared. Chosen, sensitivity not measured."""


def other_readings(
    poses: Float[ndarray, "m 4 4"],
    options: PoseOptions,
    *,
    folder: Folder | None = None,
    quaternions: bool = False,
    at: Callable[[Float[ndarray, "m 4 4"], PoseOptions], Float[ndarray, "t 4 4"]] = lambda poses, options: poses,
) -> dict[str, Float[ndarray, "t 4 4"]]:
    """The poses under the other directions, axes, orders of quaternions and units, by the options for them.

    Units are read otherwise only where cameras would be far apart. A hand-eye calibration is also read the other way.

    Args:
        quaternions: whether the poses are written as quaternions.
        at: poses as written at the frames' times, from those in the file, under some options.
    """
    reordered = {options.quat: poses}
    if quaternions:
        reordered["xyzw" if options.quat == "wxyz" else "wxyz"] = _reordered(poses, options.quat)
    centres = poses[np.isfinite(poses).all(axis=(1, 2)), :3, 3] * METRES_PER_UNIT[options.pose_unit]
    is_far = len(centres) > 0 and float(np.ptp(centres, axis=0).max()) > FAR_APART
    units = [options.pose_unit, *(unit for unit in METRES_PER_UNIT if is_far and unit != options.pose_unit)]
    readings = {}
    for quat, unit, pose_is, axes in product(reordered, units, get_args(PoseIs), get_args(Axes)):
        read = {"pose_is": pose_is, "axes": axes, "quat": quat, "pose_unit": unit}
        changed = {name for name, value in read.items() if value != getattr(options, name)}
        if not changed or {"quat", "pose_unit"} <= changed:
            continue
        if changed & {"pose_is", "axes"}:
            changed |= {"pose_is", "axes"}
        name = " ".join(f"--{key.replace('_', '-')} {read[key]}" for key in read if key in changed)
        under = options.model_copy(update=read)
        readings[name] = to_world_from_camera(at(reordered[quat], under), under, folder=folder)[0]
    if options.gripper_from_camera:
        bare = options.model_copy(update={"gripper_from_camera": "", "axes": "opencv"})
        world_from_gripper = to_world_from_camera(at(poses, options), bare)[0]
        camera_from_gripper, _ = _hand_eye(options, folder)
        inverse = world_from_gripper @ invert_rigid(camera_from_gripper)
        readings["the inverse of --gripper-from-camera"] = _in_opencv(inverse, options.axes)
    return readings


def _reordered(poses: Float[ndarray, "t 4 4"], quat: str) -> Float[ndarray, "t 4 4"]:
    """Poses read from quaternions in one order, as the other order would have read them. Their sign plays no part."""
    found = poses.copy()
    known = np.isfinite(poses).all(axis=(1, 2))
    quat_xyzw = Rotation.from_matrix(poses[known, :3, :3]).as_quat()
    found[known, :3, :3] = Rotation.from_quat(np.roll(quat_xyzw, -1 if quat == "xyzw" else 1, axis=1)).as_matrix()
    return found


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
