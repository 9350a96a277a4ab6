"""Options of `ingest lerobot`."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, FiniteFloat

from bask_data.formats.options.common import EpisodeOptions, IntrinsicsSize, PoseOptions, Text


class LerobotOptions(EpisodeOptions, PoseOptions):
    """An episode of a LeRobot dataset."""

    cameras: tuple[str, ...] = Field(
        (), description="Cameras to read: wrist,front. All with colour and depth by default; the others are named."
    )
    depth: str = Field(
        "",
        description="Features with depth, if their names do not say whose: observation.images.{camera}_z, or "
        "NAME=FEATURE;NAME=FEATURE.",
    )
    depth_scale: FiniteFloat | None = Field(
        None,
        gt=0,
        description="Metres per unit of depth in images and arrays, if the files do not state it. Otherwise whole "
        "numbers are millimetres and floating point is metres, as LeRobot has it.",
    )
    intrinsics: Text = Field(
        "",
        description="Intrinsics, which LeRobot has no place for: fx,fy,cx,cy or a file, as for `frames`; of several "
        "cameras NAME=...;NAME=..., or a file name with {camera}.",
    )
    intrinsics_size: IntrinsicsSize = ""
    pose_column: str = Field(
        "",
        description="Columns with the cameras' poses, of 16, 12 or 7 numbers, if no name says so: "
        "observation.{camera}.pose, or NAME=COLUMN;NAME=COLUMN. COLUMN[3:10] takes a part.",
    )
    column_major: bool = Field(
        False, description="Matrices of poses are written column by column, the translation last."
    )
    camera_pose: str = Field(
        "", description="Files with the poses of cameras that do not move: NAME=FILE;NAME=FILE, each as a pose file."
    )
    gripper_pose: str = Field(
        "",
        description="Column with world_from_gripper: observation.state[0:7]. Needed for --gripper-from-camera, unless "
        "the names x, y, z, qx, qy, qz, qw of its values say so.",
    )
    gripper_rotation: Literal["auto", "quaternion", "matrix", "rotvec"] = Field(
        "auto",
        description="How the gripper's rotation is written: auto takes 7 numbers for a quaternion, and 12 or 16 for a "
        "matrix; 6 may be a rotation vector, in radians.",
    )
    gripper_width: str = Field("", description="Column with the gripper's opening in metres: observation.state[7].")
