"""Demonstrations: RGB-D frames of a task, and the robot's states and actions."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from bask_data.artifact import write_group
from bask_data.kinds.arrays import read_all, write_array
from bask_data.kinds.cameras import CAMERA_ARRAYS, Recording, RecordingMetadata
from bask_data.specs import ArraySpec

if TYPE_CHECKING:
    import numpy as np
    import zarr


class DemonstrationMetadata(RecordingMetadata):
    """Metadata of a recording, and names of the action's columns."""

    action_names: list[str] = []


class Robot:
    """The robot's states and actions; None for those not recorded.

    Args:
        world_from_gripper: (t, 4, 4), metres.
        gripper_width: (t,), metres.
        action: (t, a), units as recorded.
        action_names: names of the action's columns.
    """

    def __init__(
        self,
        world_from_gripper: np.ndarray | None = None,
        gripper_width: np.ndarray | None = None,
        action: np.ndarray | None = None,
        action_names: tuple[str, ...] = (),
    ) -> None:
        self.world_from_gripper = world_from_gripper
        self.gripper_width = gripper_width
        self.action = action
        self.action_names = action_names

    def __repr__(self) -> str:
        arrays = (("world_from_gripper", self.world_from_gripper), ("gripper_width", self.gripper_width))
        shapes = [f"{name} {values.shape}" for name, values in (*arrays, ("action", self.action)) if values is not None]
        return f"Robot({', '.join(shapes) or 'nothing recorded'})"


class Demonstration(Recording):
    """RGB-D frames of a robot at work."""

    kind = "demonstration"
    scope = "demonstration"
    metadata_model = DemonstrationMetadata
    arrays = {
        **CAMERA_ARRAYS,
        "robot/world_from_gripper": ArraySpec(
            ("t", "4", "4"), "float64", "Takes gripper coordinates to world coordinates.", "metre", optional=True
        ),
        "robot/gripper_width": ArraySpec(("t",), "float64", "Opening of the gripper.", "metre", optional=True),
        "robot/action": ArraySpec(
            ("t", "a"), "float64", "What was commanded; columns as `action_names` says.", optional=True
        ),
    }

    @property
    def robot(self) -> Robot | None:
        """The robot's states and actions; None if only cameras were recorded."""
        if "robot" not in self.group:
            return None
        names = [name for name in ("world_from_gripper", "gripper_width", "action") if f"robot/{name}" in self.group]
        arrays = {name: read_all(self.group, f"robot/{name}", self.path) for name in names}
        return Robot(**arrays, action_names=tuple(self.metadata.action_names))

    @staticmethod
    def write_robot(out: Path, group: zarr.Group, robot: Robot) -> None:
        """Write the robot's states and actions."""
        write_group(out / "robot", {"bask": {"role": "robot"}})
        for name in ("world_from_gripper", "gripper_width", "action"):
            values = getattr(robot, name)
            if values is not None:
                write_array(group, Demonstration, f"robot/{name}", values)
