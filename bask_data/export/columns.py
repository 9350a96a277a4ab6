"""Columns of an export, common to all formats: names, units and values of each frame."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from bask_data.errors import BadData
from bask_data.kinds import Demonstration, KeypointTrack

if TYPE_CHECKING:
    import numpy as np

CONVENTIONS = {
    "units": "SI: metres, seconds, radians, unless a column says otherwise.",
    "world": "Positions are in the demonstration's world frame, to which the poses of cameras and gripper refer.",
    "origin": "What was subtracted from all positions, metres, so that float32 holds them. Only if it is not zero, "
    "columns named ..._world repeat them in float64 with it, in the source's world frame. Actions are as recorded.",
    "keypoints": "Mean of the filter's belief after the frame; x, y, z of the first keypoint, then of the second. "
    "A keypoint that is not localised keeps its last localised position (or has its first one before that).",
    "spread": "Square root of the trace of the belief's covariance: root mean square distance of the keypoint from its "
    "mean. Added noise is not included.",
    "gripper_rotation": "First and second column of the rotation in world_from_gripper: the gripper's x and y axes in "
    "the world. The third is their cross product.",
    "action": "As recorded, in the frame of the observation for which it was chosen.",
    "frames": "Frames of all cameras, the robot and the keypoints correspond by number.",
}
"""Conventions of all formats, written into every export."""


@dataclass(frozen=True)
class Column:
    """A quantity of every frame.

    Args:
        values: names of its values in their order; empty for a scalar.
    """

    name: str
    values: tuple[str, ...]
    dtype: str
    description: str
    units: str = ""

    @property
    def width(self) -> int:
        """Number of values per frame."""
        return len(self.values) or 1


STATE = ("keypoints", "spread", "gripper_position", "gripper_rotation", "gripper_width")
"""Columns of a policy's observation, in order."""

POSITIONS = ("keypoints", "gripper_position")
"""Columns of positions, from which an origin is subtracted."""


def columns_of(demonstration: Demonstration, track: KeypointTrack, is_far: bool) -> list[Column]:
    """Columns of a demonstration: its keypoints, and its robot if recorded.

    Args:
        is_far: an origin was subtracted: positions come once more, without it.
    """
    group, names = demonstration.group, tuple(track.names)
    coordinates = tuple(f"{keypoint}.{axis}" for keypoint in names for axis in "xyz")
    axes = tuple(f"gripper.{axis}_{of}" for axis in ("x_axis", "y_axis") for of in "xyz")
    columns = [
        Column("time", (), "float64", "Time of the frame, as recorded.", "second"),
        Column("keypoints", coordinates, "float32", "Positions of the keypoints in the world frame.", "metre"),
        Column("spread", tuple(f"{n}.spread" for n in names), "float32", CONVENTIONS["spread"], "metre"),
        Column("observed", names, "bool", "Whether any camera more likely than not sees the keypoint in this frame."),
        Column("localised", names, "bool", "Whether the keypoint's position is of this frame, not kept from another."),
    ]
    if "robot/world_from_gripper" in group:
        positions = tuple(f"gripper.{axis}" for axis in "xyz")
        columns += [
            Column("gripper_position", positions, "float32", "Origin of the gripper in the world frame.", "metre"),
            Column("gripper_rotation", axes, "float32", CONVENTIONS["gripper_rotation"]),
        ]
    if "robot/gripper_width" in group:
        columns.append(Column("gripper_width", ("gripper.width",), "float32", "Opening of the gripper.", "metre"))
    if "robot/action" in group:
        n_actions = group["robot/action"].shape[1]  # type: ignore[union-attr]
        named = tuple(demonstration.metadata.action_names) or tuple(f"action_{i}" for i in range(n_actions))
        columns.append(Column("action", named, "float32", "Commanded action; units as recorded."))
    if is_far:
        again = "The same in the source's world frame, with `origin`."
        repeated = [column for column in columns if column.name in POSITIONS]
        columns += [Column(f"{near.name}_world", near.values, "float64", again, "metre") for near in repeated]
    return columns


def robot_values(demonstration: Demonstration) -> dict[str, np.ndarray]:
    """The robot's states and actions, (t, ...) each, by column name."""
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
    """A column's values (t, width) or (t,) in its type; `BadData` for missing frames or values that are not finite."""
    import numpy as np

    if len(values) != n_frames:
        expected = f"{n_frames} frames, as the cameras have"
        raise BadData(demonstration.path, column.name, expected=expected, got=len(values), fix="ingest it again.")
    if not np.isfinite(values).all():
        fix = "ingest a complete recording, or leave the demonstration out with --only."
        raise BadData(demonstration.path, column.name, expected="finite numbers", got="NaN or infinity", fix=fix)
    shape = (n_frames, column.width) if column.values else (n_frames,)
    return np.ascontiguousarray(values.reshape(shape), dtype=column.dtype)
