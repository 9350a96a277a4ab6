"""What happened in a recording: the joints' positions at each frame. Small; pictures are drawn from it when needed."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Float
from numpy import ndarray

from bask_data.sim.world import Layout


@dataclass(frozen=True)
class RobotMotion:
    """What the gripper did at each frame, and what it was told to do."""

    world_from_gripper: Float[ndarray, "t 4 4"]
    gripper_width: Float[ndarray, " t"]
    action: Float[ndarray, "t a"]
    action_names: tuple[str, ...]


@dataclass(frozen=True)
class Take:
    """A scan or a demonstration as it happened.

    Attributes:
        time: seconds of each frame.
        shows_gripper: whether the gripper is in the pictures.
        touching: pairs of labels whose bodies touch at the first frame.
    """

    layout: Layout
    qpos: Float[ndarray, "t q"]
    time: Float[ndarray, " t"]
    world_from_objects: Float[ndarray, "t k 4 4"]
    touching: list[tuple[int, int]]
    shows_gripper: bool
    robot: RobotMotion | None = None
