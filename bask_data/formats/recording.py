"""The return type of readers: a recording converted to our frames and units, with frames read on demand."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8, UInt16
from numpy import ndarray


@dataclass(frozen=True)
class CameraRecording:
    """Frames of one camera.

    Args:
        K: intrinsics of all frames, or of each, pixels.
        depth_scale: metres per unit of raw depth.
        time: seconds.
        read: RGB and raw depth of a frame, 0 = no measurement.
        labels: object label at each pixel of a frame, 0 = none: ground truth, for reports only.
    """

    name: str
    K: Float[ndarray, "3 3"] | Float[ndarray, "t 3 3"]
    height: int
    width: int
    depth_scale: float
    world_from_cameras: Float[ndarray, "t 4 4"]
    time: Float[ndarray, " t"]
    read: Callable[[int], tuple[UInt8[ndarray, "h w 3"], UInt16[ndarray, "h w"]]]
    labels: Callable[[int], UInt8[ndarray, "h w"]] | None = None

    @property
    def n_frames(self) -> int:
        """Number of frames."""
        return len(self.time)

    @property
    def Ks(self) -> Float[ndarray, "t 3 3"]:
        """Intrinsics of each frame, pixels."""
        return np.broadcast_to(self.K, (self.n_frames, 3, 3))


@dataclass(frozen=True)
class RobotRecording:
    """The robot's state and action at each frame; None where the source has none. The gripper's width is in metres."""

    world_from_gripper: Float[ndarray, "t 4 4"] | None = None
    gripper_width: Float[ndarray, " t"] | None = None
    action: Float[ndarray, "t a"] | None = None
    action_names: tuple[str, ...] | None = None


@dataclass(frozen=True)
class ObjectPose:
    """Ground-truth pose of a static object, for reports only.

    Args:
        error: error of the transform stated by its source, metres.
    """

    world_from_object: Float[ndarray, "4 4"]
    error: float


@dataclass(frozen=True)
class SourceRecording:
    """A scan or a demonstration as read.

    Args:
        label_names: names of the objects by label.
        assumptions: what the files do not state, in words; printed, and stored in the recording.
        files: all source files that were used, for the digest.
        object_poses: ground-truth poses by label.
    """

    cameras: tuple[CameraRecording, ...]
    robot: RobotRecording | None
    label_names: dict[int, str]
    assumptions: dict[str, str]
    files: tuple[Path, ...]
    object_poses: dict[int, ObjectPose] = field(default_factory=dict)

    @property
    def has_labels(self) -> bool:
        """Whether any camera has labels."""
        return any(camera.labels for camera in self.cameras)
