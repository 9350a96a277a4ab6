"""The motions of a recording: joint positions at each frame, from which images are rendered on demand."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Float
from numpy import ndarray

from bask_data.sim.world import Layout


@dataclass(frozen=True)
class RobotMotion:
    """The gripper's pose and width, metres, and its commands, at each frame; see `ACTION_NAMES`."""

    world_from_gripper: Float[ndarray, "t 4 4"]
    gripper_width: Float[ndarray, " t"]
    action: Float[ndarray, "t a"]
    action_names: tuple[str, ...]


@dataclass(frozen=True)
class Take:
    """The motions of a scan or a demonstration.

    Args:
        qpos: MuJoCo's joint positions.
        time: seconds.
        world_from_objects: poses of the labelled bodies, metres.
        touching: pairs of labels whose bodies touch at the first frame.
        shows_gripper: whether the gripper is rendered.
        robot: None for a scan.
    """

    layout: Layout
    qpos: Float[ndarray, "t q"]
    time: Float[ndarray, " t"]
    world_from_objects: Float[ndarray, "t k 4 4"]
    touching: list[tuple[int, int]]
    shows_gripper: bool
    robot: RobotMotion | None = None
