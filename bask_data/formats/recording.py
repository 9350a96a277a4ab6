"""What every reader returns: somebody else's recording in our frames and units, frames read on demand."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from jaxtyping import Float, UInt8, UInt16
from numpy import ndarray


@dataclass(frozen=True)
class CameraRecording:
    """One camera's frames.

    `read(i)` gives colour (RGB) and raw depth, 0 = no measurement; metres are `depth * depth_scale`. `labels(i)` gives
    an object's label at each pixel, 0 = none: truth, for reports only.
    """

    name: str
    K: Float[ndarray, "3 3"]
    height: int
    width: int
    depth_scale: float
    world_from_cameras: Float[ndarray, "t 4 4"]
    time: Float[ndarray, " t"]
    read: Callable[[int], tuple[UInt8[ndarray, "h w 3"], UInt16[ndarray, "h w"]]]
    labels: Callable[[int], UInt8[ndarray, "h w"]] | None = None

    @property
    def n_frames(self) -> int:
        return len(self.time)


@dataclass(frozen=True)
class RobotRecording:
    """What the robot reported at each frame; None for what the source does not hold."""

    world_from_gripper: Float[ndarray, "t 4 4"] | None = None
    gripper_width: Float[ndarray, " t"] | None = None
    action: Float[ndarray, "t a"] | None = None
    action_names: tuple[str, ...] | None = None


@dataclass(frozen=True)
class ObjectPose:
    """Where a static object stands: truth, for reports only.

    Args:
        error: metres the transform may be wrong by, as whoever made it says.
    """

    world_from_object: Float[ndarray, "4 4"]
    error: float


@dataclass(frozen=True)
class SourceRecording:
    """A scan or a demonstration as read.

    `assumptions` says in words what the files do not; the caller prints and records it. `files` are all the source
    files that were used, for digesting.
    """

    cameras: tuple[CameraRecording, ...]
    robot: RobotRecording | None
    label_names: dict[int, str]
    assumptions: dict[str, str]
    files: tuple[Path, ...]
    object_poses: dict[int, ObjectPose] = field(default_factory=dict)

    @property
    def has_labels(self) -> bool:
        """Whether any camera comes with labels."""
        return any(camera.labels for camera in self.cameras)
