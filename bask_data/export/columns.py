"""The quantities that every frame of an export has, whatever the format: names, units and values."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from bask_data.errors import BadData
from bask_data.kinds import Demonstration, KeypointTrack

if TYPE_CHECKING:
    import numpy as np

CONVENTIONS = {
    "units": "SI: metres, seconds, radians, unless a column says otherwise.",
    "world": "Positions are in the world frame of the demonstration, the one its cameras and gripper are posed in.",
    "keypoints": "Mean of the filter's belief after the frame; x, y, z of the first keypoint, then of the second. "
    "Where a keypoint is not localised, its last place is kept (before the first, the first one).",
    "spread": "Square root of the trace of the belief's covariance: how far, in the mean square, the keypoint may be "
    "from its mean. Noise that was added is not in it.",
    "gripper_rotation": "First and second column of the rotation in world_from_gripper: the gripper's x and y axes in "
    "the world. The third is their cross product.",
    "action": "As recorded, in the same frame as the observations it was chosen at.",
    "frames": "Frames of all cameras, robot and keypoints belong together by number.",
}


@dataclass(frozen=True)
class Column:
    """A quantity that every frame has.

    Args:
        values: names of its values in their order; none for a single number.
    """

    name: str
    values: tuple[str, ...]
    dtype: str
    description: str
    units: str = ""

    @property
    def width(self) -> int:
        """How many numbers a frame has of it."""
        return len(self.values) or 1


STATE = ("keypoints", "spread", "gripper_position", "gripper_rotation", "gripper_width")
"""Columns that make up a policy's observation, in its order."""


def columns_of(demonstration: Demonstration, track: KeypointTrack) -> list[Column]:
    """What every frame of a demonstration has: of its keypoints, and of its robot where one was recorded."""
    group, names = demonstration.group, track.names
    coordinates = tuple(f"{keypoint}.{axis}" for keypoint in names for axis in "xyz")
    axes = tuple(f"gripper.{axis}_{of}" for axis in ("x_axis", "y_axis") for of in "xyz")
    here, each = "Whether a camera more likely than not sees the keypoint in this frame.", tuple(names)
    columns = [
        Column("time", (), "float64", "Time of the frame, as recorded.", "second"),
        Column("keypoints", coordinates, "float32", "Positions of the keypoints in the world.", "metre"),
        Column("spread", tuple(f"{n}.spread" for n in names), "float32", CONVENTIONS["spread"], "metre"),
        Column("observed", each, "bool", here),
        Column("localised", each, "bool", "Whether the keypoint's position is of this frame, not of another."),
    ]
    if "robot/world_from_gripper" in group:
        places = tuple(f"gripper.{axis}" for axis in "xyz")
        columns += [
            Column("gripper_position", places, "float32", "Origin of the gripper in the world.", "metre"),
            Column("gripper_rotation", axes, "float32", CONVENTIONS["gripper_rotation"]),
        ]
    if "robot/gripper_width" in group:
        columns.append(Column("gripper_width", ("gripper.width",), "float32", "Opening of the gripper.", "metre"))
    if "robot/action" in group:
        n_actions = group["robot/action"].shape[1]  # type: ignore[union-attr]
        named = tuple(demonstration.metadata.action_names) or tuple(f"action_{i}" for i in range(n_actions))
        columns.append(Column("action", named, "float32", "What was commanded; units as recorded."))
    return columns


def robot_values(demonstration: Demonstration) -> dict[str, np.ndarray]:
    """What the robot reported, by the names of the columns; (t, ...) each."""
    robot = demonstration.robot
    values: dict[str, np.ndarray] = {}
    if robot is None:
        return values
    if robot.world_from_gripper is not None:
        grippers = robot.world_from_gripper
        values["gripper_position"] = grippers[:, :3, 3]
        values["gripper_rotation"] = grippers[:, :3, :2].swapaxes(1, 2)
    if robot.gripper_width is not None:
        values["gripper_width"] = robot.gripper_width[:, None]
    if robot.action is not None:
        values["action"] = robot.action
    return values


def checked(values: np.ndarray, column: Column, demonstration: Demonstration, n_frames: int) -> np.ndarray:
    """A column as it is written, every number of it finite and every frame there."""
    import numpy as np

    if len(values) != n_frames:
        expected = f"{n_frames} frames, as the cameras have"
        raise BadData(demonstration.path, column.name, expected=expected, got=len(values), fix="ingest it again.")
    if not np.isfinite(values).all():
        raise BadData(demonstration.path, column.name, expected="finite numbers", got="NaN or infinity")
    shape = (n_frames, column.width) if column.values else (n_frames,)
    return np.ascontiguousarray(values.reshape(shape), dtype=column.dtype)
