"""Robot of a LeRobot dataset: its gripper's pose and width, and its actions, as far as names or options say."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from bask_data.errors import UsageError
from bask_data.formats.lerobot.cameras import words_of
from bask_data.formats.lerobot.columns import EpisodeRows
from bask_data.formats.lerobot.poses import gripper_transforms
from bask_data.formats.options.lerobot import LerobotOptions
from bask_data.formats.poses import LENGTH_NAMES, METRES_PER_UNIT
from bask_data.formats.recording import RobotRecording

STATE = "observation.state"

RECORDED = "recorded_"
"""Beginning of the columns in which `bask-data export lerobot --cameras` keeps what LeRobot's columns round."""

POSE_NAMES = ("x", "y", "z", "qx", "qy", "qz", "qw")


@dataclass(frozen=True)
class RobotColumns:
    """What the tables say of the robot.

    Args:
        gripper: the gripper's poses as written, and their column; None if unknown.
        used: the columns they are from.
    """

    robot: RobotRecording | None
    gripper: tuple[Float[ndarray, "t 4 4"], str] | None
    assumptions: dict[str, str]
    used: tuple[str, ...]


def read_robot(rows: EpisodeRows, options: LerobotOptions) -> RobotColumns:
    """Robot of an episode; `UsageError` if an option names what is not there."""
    column, assumptions = options.gripper_pose or _pose_column(rows), {}
    gripper, world_from_gripper = None, None
    if column:
        written = gripper_transforms(column, rows.part("--gripper-pose", column), options)
        gripper = (written, column)
        world_from_gripper = written.copy()
        world_from_gripper[:, :3, 3] *= METRES_PER_UNIT[options.pose_unit]
        assumptions["gripper"] = f"{column}: world_from_gripper, {LENGTH_NAMES[options.pose_unit]}"
    width = options.gripper_width or _width_column(rows)
    if width:
        assumptions["gripper width"] = f"{width}, metres"
    action, names = _action(rows)
    robot = RobotRecording(
        world_from_gripper=world_from_gripper,
        gripper_width=_single(rows, width) if width else None,
        action=action,
        action_names=names,
    )
    is_empty = world_from_gripper is None and not width and action is None
    return RobotColumns(None if is_empty else robot, gripper, assumptions, (column, width))


def _pose_column(rows: EpisodeRows) -> str:
    """The part of the state that is the gripper's pose, by the names of its values; empty if none is."""
    if rows.has(f"{RECORDED}world_from_gripper"):
        return f"{RECORDED}world_from_gripper"
    names = [name.lower() for name in rows.named(STATE)]
    found = []
    for i in range(len(names) - len(POSE_NAMES) + 1):
        part = names[i : i + len(POSE_NAMES)]
        prefix = part[0].removesuffix("x")
        if part == [prefix + name for name in POSE_NAMES]:
            found.append(f"{STATE}[{i}:{i + len(POSE_NAMES)}]")
    return found[0] if len(found) == 1 and rows.has(STATE) else ""


def _width_column(rows: EpisodeRows) -> str:
    """The value of the state that is the gripper's width, by its name; empty if none is."""
    if rows.has(f"{RECORDED}gripper_width"):
        return f"{RECORDED}gripper_width"
    names = rows.named(STATE)
    found = [i for i, name in enumerate(names) if {"gripper", "width"} <= set(words_of(name))]
    return f"{STATE}[{found[0]}]" if len(found) == 1 and rows.has(STATE) else ""


def _single(rows: EpisodeRows, text: str) -> Float[ndarray, " t"]:
    values = rows.part("--gripper-width", text)
    if values.shape[1] != 1:
        raise UsageError("--gripper-width", expected="one number", got=f"{values.shape[1]} in {text}", fix="COLUMN[i]")
    return np.ascontiguousarray(values[:, 0])


def _action(rows: EpisodeRows) -> tuple[Float[ndarray, "t a"] | None, tuple[str, ...] | None]:
    for column in (f"{RECORDED}action", "action"):
        if rows.has(column) and column in rows.numeric:
            values = rows.column(column)
            names = rows.named(column)
            return values, names if len(names) == values.shape[1] else None
    return None, None
