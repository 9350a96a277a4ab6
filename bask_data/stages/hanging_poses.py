"""Frames whose pose hangs: it stays that of an earlier frame although the camera moved on.

They agree with each other's poses and may be many, so that a mesh of all frames would have the good ones stand out.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from bask_data.kinds import Camera
from bask_data.stages.mesh_quality import FrameOfCamera

if TYPE_CHECKING:
    from bask_data.core.sensor_frames import BlockPoints

LEAST_RUN = 3
"""Frames of one pose that are looked at: of two, one more or less does not matter."""


@dataclass(frozen=True)
class HangingPose:
    """Frames of a camera that have the pose of the first of them.

    Args:
        frames: numbers, the first one's left out: its pose may be right.
        moved: metres by which the surface moved meanwhile, infinite if it left the view.
    """

    camera: str
    first: int
    frames: tuple[int, ...]
    moved: float


def hanging_poses(frames: list[FrameOfCamera]) -> list[HangingPose]:
    """All stretches of frames whose pose hangs; two frames of each stretch of equal poses are read.

    Not those of a camera whose poses are all the same: it is said to rest.
    """
    import numpy as np

    from bask_data.core.sensor_motion import same_pose_runs, surfaces_apart

    hanging = []
    for name in sorted({camera.name for camera, _ in frames}):
        camera = next(camera for camera, _ in frames if camera.name == name)
        own = np.array([i for other, i in frames if other.name == name])
        for first, last in same_pose_runs(camera.world_from_cameras[own]):
            if last - first + 1 < LEAST_RUN or last - first + 1 == len(own):
                continue
            moved = surfaces_apart(_blocks(camera, int(own[first])), _blocks(camera, int(own[last])))
            if moved > 0:
                numbers = tuple(own[first + 1 : last + 1].tolist())
                hanging.append(HangingPose(name, int(own[first]), numbers, moved))
    return hanging


def hanging_warnings(hanging: list[HangingPose], left_out: bool) -> list[str]:
    """Warnings for the user, with what to do."""
    warnings = []
    for each in hanging:
        moved = f"moved by {100 * each.moved:.1f} cm" if each.moved < float("inf") else "left the view"
        frames = f"{each.frames[0]}-{each.frames[-1]}"
        done = (
            "They were left out of the mesh; --no-drop-suspects keeps them."
            if left_out
            else f"To leave them out: --exclude {each.camera}:{frames}"
        )
        warnings.append(
            f"frames {frames} of {each.camera} have the pose of frame {each.first}, but the surface {moved}: their "
            f"poses are wrong, not those of the others. {done}"
        )
    return warnings


def _blocks(camera: Camera, i_frame: int) -> BlockPoints:
    import numpy as np

    from bask_data.core.sensor_frames import block_points

    depth = camera.depth(i_frame)
    return block_points(np.zeros(depth.shape, np.uint8), depth, camera.Ks[i_frame])
