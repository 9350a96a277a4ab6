"""What readers return, `SourceRecording`, and what becomes of it, `PreparedRecording`.

A reader states what its files hold: our frames and units, but depth, lens and faults as they are. `prepare` makes the
rest alike for all formats: it leaves frames out, takes the lens distortion out, brings depth and colour onto the same
pixels, and moves the world's origin near.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32, UInt8, UInt16
from numpy import ndarray

from bask_data.core.lens import Distortion, Lens
from bask_data.errors import BadData
from bask_data.formats.verdict import Agreement, Registration

Depth = UInt16[ndarray, "h w"] | Float32[ndarray, "h w"]
"""Raw depth of a frame: 0 means no measurement; in floating-point depth also NaN, infinite and negative values."""


@dataclass(frozen=True)
class SourceCamera:
    """Frames of one camera as the files hold them. Frames are read on demand, in any order, cheapest in their own.

    Every array and every function over frames covers all of the source's frames, also bad ones.

    Args:
        frames: name of each frame, for messages; what `--labels` is matched with.
        lens: of the colour images, K (3, 3) or (t, 3, 3), pixels.
        world_from_cameras: poses of the colour camera in OpenCV axes, metres, not checked: not finite where unknown.
        time: seconds.
        color: RGB of a frame (h, w, 3).
        depth: raw depth of a frame, z along the optical axis.
        depth_scale: metres per unit of raw depth.
        depth_lens: of the depth images; None if depth lies on colour pixel by pixel.
        color_from_depth: pose of the depth camera in the colour camera (4, 4), metres; None: the same camera.
        confidence: confidence of a frame's depth, of its size; larger is better.
        labels: object label at each pixel of a frame's colour, 0 = none: ground truth, for reports only.
        faults: why frames cannot be used, as far as the reader knows; by index. `--skip-bad` leaves them out.
        expected: those of the faults that the format itself has, as ScanNet's frames of lost tracking, with the kind of
            fault in one or two words; by index. They are left out without `--skip-bad`.
        pose_places: where the pose of each frame stands, for messages.
        intrinsics_size: WIDTHxHEIGHT of the images that the intrinsics are said to be for, or empty.
        otherwise: `world_from_cameras` under other readings of the same files, by the options for them.
        farthest: largest depth that floating-point depth holds, metres, where the source states it.
    """

    name: str
    frames: tuple[str, ...]
    lens: Lens
    world_from_cameras: Float[ndarray, "t 4 4"]
    time: Float[ndarray, " t"]
    color: Callable[[int], UInt8[ndarray, "h w 3"]]
    depth: Callable[[int], Depth]
    depth_scale: float = 1.0
    depth_lens: Lens | None = None
    color_from_depth: Float[ndarray, "4 4"] | None = None
    confidence: Callable[[int], UInt8[ndarray, "h w"]] | None = None
    labels: Callable[[int], UInt8[ndarray, "h w"]] | None = None
    faults: dict[int, BadData] = field(default_factory=dict)
    expected: dict[int, str] = field(default_factory=dict)
    pose_places: tuple[str, ...] = ()
    intrinsics_size: str = ""
    otherwise: dict[str, Float[ndarray, "t 4 4"]] = field(default_factory=dict)
    farthest: float | None = None

    def pose_place(self, i: int) -> str:
        """Where the pose of a frame stands, for messages."""
        return self.pose_places[i] if self.pose_places else f"{self.name} {self.frames[i]}"


@dataclass(frozen=True)
class CameraRecording:
    """Frames of one camera, ready to be written: pinhole images, depth on colour, rigid poses near the origin.

    Args:
        K: (3, 3) or (t, 3, 3), pixels.
        depth_scale: metres per unit of raw depth.
        time: seconds.
        read: RGB and raw depth of a frame, 0 = no measurement.
        read_depth: raw depth alone.
        labels: object label at each pixel of a frame, 0 = none: ground truth, for reports only.
        distortion: the lens distortion that is taken out.
    """

    name: str
    K: Float[ndarray, "3 3"] | Float[ndarray, "t 3 3"]
    height: int
    width: int
    depth_scale: float
    world_from_cameras: Float[ndarray, "t 4 4"]
    time: Float[ndarray, " t"]
    read: Callable[[int], tuple[UInt8[ndarray, "h w 3"], UInt16[ndarray, "h w"]]]
    read_depth: Callable[[int], UInt16[ndarray, "h w"]]
    labels: Callable[[int], UInt8[ndarray, "h w"]] | None = None
    distortion: Distortion | None = None

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
        robot: its arrays have a row for each of the cameras' frames, bad ones too.
        label_names: names of the objects by label.
        assumptions: what the files do not state, in words; printed, and stored in the recording.
        files: all source files that were used, for the digest.
        object_poses: ground-truth poses by label.
        completed: what takes long to compute, if anything does: from this recording, with its labels, the whole one. It
            is called only if the recording has to be written, and changes neither files nor the frames' names.
    """

    cameras: tuple[SourceCamera, ...]
    robot: RobotRecording | None
    label_names: dict[int, str]
    assumptions: dict[str, str]
    files: tuple[Path, ...]
    object_poses: dict[int, ObjectPose] = field(default_factory=dict)
    completed: Callable[[SourceRecording], SourceRecording] | None = None

    @property
    def has_labels(self) -> bool:
        """Whether any camera has labels."""
        return any(camera.labels for camera in self.cameras)


@dataclass(frozen=True)
class PreparedRecording:
    """A scan or a demonstration, ready to be written.

    Args:
        assumptions: those of the reader, and what was done to its frames.
        origin: metres; the source's world coordinates are ours plus this.
        agreements: what depth says about the way each camera was read.
        registrations: whether the depth of each camera lies on its colour.
        left_out: why frames were left out, by `camera/frame`.
    """

    cameras: tuple[CameraRecording, ...]
    robot: RobotRecording | None
    label_names: dict[int, str]
    assumptions: dict[str, str]
    files: tuple[Path, ...]
    object_poses: dict[int, ObjectPose]
    agreements: dict[str, Agreement]
    registrations: dict[str, Registration]
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    left_out: dict[str, str] = field(default_factory=dict)

    @property
    def has_labels(self) -> bool:
        """Whether any camera has labels."""
        return any(camera.labels for camera in self.cameras)
