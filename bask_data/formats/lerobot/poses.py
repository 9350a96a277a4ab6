"""Poses of a LeRobot dataset's cameras and gripper, for which the format has no place of its own."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from bask_data.errors import UsageError
from bask_data.formats.choices import by_camera
from bask_data.formats.files import Folder, listed
from bask_data.formats.lerobot.cameras import CameraFeatures, columns_for
from bask_data.formats.lerobot.columns import POSE_WIDTHS, EpisodeRows
from bask_data.formats.options.lerobot import LerobotOptions
from bask_data.formats.poses import (
    LENGTH_NAMES,
    other_readings,
    parse_transform,
    read_pose,
    refuse_transposed,
    to_world_from_camera,
)

_CAMERA, _WORLD = r"cam(?:era)?", r"(?:world|base)"
DIRECTIONS = {
    "world_from_camera": re.compile(rf"{_WORLD}_from_{_CAMERA}|{_CAMERA}_?(?:2|to)_?{_WORLD}|c2w"),
    "camera_from_world": re.compile(rf"{_CAMERA}_from_{_WORLD}|{_WORLD}_?(?:2|to)_?{_CAMERA}|w2c"),
}
"""What a column's name says of the direction of the poses in it."""


@dataclass(frozen=True)
class CameraPoses:
    """Poses of a camera, and what they were taken for.

    Args:
        place: column or file, for messages.
        column: column they are from, if any.
        otherwise: other readings, by options.
        files: files they came from, besides the tables.
    """

    world_from_cameras: Float[ndarray, "t 4 4"]
    place: str
    statement: str
    otherwise: dict[str, Float[ndarray, "t 4 4"]] = field(default_factory=dict)
    files: tuple[Path, ...] = ()
    column: str = ""


def direction_of(column: str) -> str | None:
    """The direction of the poses in a column, as its name says; None if it does not."""
    found = [name for name, pattern in DIRECTIONS.items() if pattern.search(column.lower())]
    return found[0] if len(found) == 1 else None


class PoseFinder:
    """Where the poses of each camera come from.

    In this order: `--camera-pose`, `--pose-column`, the gripper's pose with `--gripper-from-camera`, a column whose
    name says that it holds them.
    """

    def __init__(
        self,
        rows: EpisodeRows,
        cameras: Sequence[CameraFeatures],
        options: LerobotOptions,
        world_from_gripper: tuple[Float[ndarray, "t 4 4"], str] | None,
    ) -> None:
        """Prepare the search.

        Args:
            world_from_gripper: the gripper's poses as written, and their column.

        Raises:
            UsageError: an option names an unknown camera, or does not say which camera is in the hand.
        """
        names = [camera.name for camera in cameras]
        self._rows, self._cameras, self._options = rows, cameras, options
        self._files = by_camera("--camera-pose", options.camera_pose, names)
        self._columns = by_camera("--pose-column", options.pose_column, names)
        self._gripper = world_from_gripper
        self._in_hand = self._find_in_hand() if options.gripper_from_camera else ""

    def poses(self, camera: CameraFeatures) -> CameraPoses:
        """Poses of a camera.

        Raises:
            UsageError: they are nowhere, or several columns may hold them.
            BadData: they are no transforms.
        """
        if camera.name in self._files:
            return self._fixed(self._files[camera.name])
        if camera.name in self._columns:
            text = self._columns[camera.name]
            return self._of_column(text, self._rows.part("--pose-column", text), "given")
        if camera.name == self._in_hand:
            return self._of_hand()
        found = self._named(camera)
        if len(found) != 1:
            raise self._unknown(camera, found)
        return self._of_column(found[0], self._rows.column(found[0]), "by its name")

    def _named(self, camera: CameraFeatures) -> list[str]:
        """Columns that are this camera's poses, by their names."""
        without = {}
        for name in self._rows.numeric:
            direction = direction_of(name)
            if direction and np.prod(self._rows.info.features[name].shape) in POSE_WIDTHS:
                without[name] = DIRECTIONS[direction].sub("", name.lower())
        fitting = columns_for(camera, without.values(), len(self._cameras))
        return [name for name, rest in without.items() if rest in fitting]

    def _find_in_hand(self) -> str:
        open_ = [of for of in self._cameras if of.name not in self._files and of.name not in self._columns]
        if len(open_) > 1:
            open_ = [of for of in open_ if not self._named(of)]
        if len(open_) != 1:
            raise UsageError(
                "--gripper-from-camera",
                expected="one camera in the hand",
                got=listed([of.name for of in open_]) if open_ else "none without poses of its own",
                fix="name it with --cameras, or give the others' poses with --camera-pose or --pose-column.",
            )
        return open_[0].name

    def _fixed(self, text: str) -> CameraPoses:
        path = _file(self._rows.info.folder, text, "--camera-pose")
        options = self._options.model_copy(update={"gripper_from_camera": ""})
        poses, _, _ = to_world_from_camera(read_pose(path, options.quat)[None], options)
        repeated = np.repeat(poses, self._rows.n_frames, axis=0)
        return CameraPoses(
            repeated,
            str(path),
            f"fixed, {path.name}: {options.pose_is}, {LENGTH_NAMES[options.pose_unit]}",
            files=(path,),
        )

    def _of_column(self, column: str, values: Float[ndarray, "t n"], why: str) -> CameraPoses:
        where = f"{self._rows.table.path}: {column}"
        written = _transforms(where, values, self._options)
        options = self._options.model_copy(update={"gripper_from_camera": ""})
        direction = direction_of(column)
        if direction and "pose_is" not in options.model_fields_set:
            options = options.model_copy(update={"pose_is": direction})
        folder = self._rows.info.folder
        poses, _, _ = to_world_from_camera(written, options, folder=folder)
        is_quat = values.shape[1] == 7
        form = f"quaternions {options.quat}" if is_quat else "matrices " + _order(options)
        otherwise = other_readings(written, options, folder=folder, quaternions=is_quat)
        statement = f"column {column} ({why}): {options.pose_is}, {LENGTH_NAMES[options.pose_unit]}, {form}"
        return CameraPoses(poses, where, statement, otherwise, (), column)

    def _of_hand(self) -> CameraPoses:
        if self._gripper is None:
            raise UsageError(
                "--gripper-from-camera",
                expected="poses of the gripper",
                got="no column whose names say so",
                fix="pass --gripper-pose with the numbers' place, such as 'observation.state[0:7]'.",
            )
        written, column = self._gripper
        folder, where = self._rows.info.folder, f"{self._rows.table.path}: {column}"
        poses, _, files = to_world_from_camera(written, self._options, folder=folder)
        statement = f"gripper's pose in {column}, times {self._options.gripper_from_camera}"
        return CameraPoses(poses, where, statement, other_readings(written, self._options, folder=folder), files)

    def _unknown(self, camera: CameraFeatures, found: list[str]) -> UsageError:
        plausible = [
            name
            for name in self._rows.numeric
            if np.prod(self._rows.info.features[name].shape) in POSE_WIDTHS and name != "action"
        ]
        hint = f"pass --pose-column {found[0]}." if found else "pass --pose-column"
        if not found:
            hint += f" (of their size are {listed(plausible)})," if plausible else ","
            hint += " --gripper-pose with --gripper-from-camera, or --camera-pose FILE for a camera that does not move."
        return UsageError(
            self._rows.info.folder.path,
            f"poses of {camera.name}",
            expected="one column whose name says world_from_camera or camera_from_world",
            got=listed(found) if found else "none",
            fix=hint,
        )


def gripper_transforms(where: str, values: Float[ndarray, "t n"], options: LerobotOptions) -> Float[ndarray, "t 4 4"]:
    """Poses of the gripper, as written.

    Raises:
        UsageError: it is not clear how the rotation is written.
    """
    from scipy.spatial.transform import Rotation

    kind, width = options.gripper_rotation, values.shape[1]
    widths = {"auto": (7, 12, 16), "quaternion": (7,), "matrix": (12, 16), "rotvec": (6,)}[kind]
    if width not in widths:
        fix = "take other numbers with --gripper-pose COLUMN[i:j]."
        if width == 6 and kind == "auto":
            fix = "pass --gripper-rotation rotvec if it is a rotation vector; write Euler angles as quaternions."
        expected = f"{' or '.join(map(str, widths))} numbers"
        raise UsageError("--gripper-pose", expected=expected, got=f"{width} in {where}", fix=fix)
    if kind != "rotvec":
        return _transforms(where, values, options)
    transforms = np.tile(np.eye(4), (len(values), 1, 1))
    transforms[:, :3, :3] = Rotation.from_rotvec(np.nan_to_num(values[:, 3:])).as_matrix()
    transforms[:, :3, 3] = values[:, :3]
    transforms[~np.isfinite(values).all(axis=1)] = np.nan
    return transforms


def _order(options: LerobotOptions) -> str:
    return "column by column" if options.column_major else "row by row"


def _transforms(where: str, values: Float[ndarray, "t n"], options: LerobotOptions) -> Float[ndarray, "t 4 4"]:
    places = [f"{where} of frame {i}" for i in range(len(values))]
    parsed = [
        parse_transform(place, row, options.quat, options.column_major)
        for place, row in zip(places, values.tolist(), strict=True)
    ]
    transforms = np.stack(parsed)
    refuse_transposed(transforms, places, options.column_major)
    return transforms


def _file(folder: Folder, text: str, option: str) -> Path:
    path = Path(text)
    return path if path.is_file() else folder.member(text, option)
