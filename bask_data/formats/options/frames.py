"""Options of `ingest frames`."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, FiniteFloat

from bask_data.formats.options.common import DepthScale, IntrinsicsSize, InvalidDepth, PoseOptions, StampOptions, Text
from bask_data.params import NAMES


class FramesOptions(PoseOptions, StampOptions):
    """A folder of colour, depth and pose files."""

    camera: str = Field(
        "camera",
        pattern=NAMES,
        description="Name of the camera in the dataset, or of several: wrist,overhead. {camera} in the other options "
        "stands for it.",
    )
    color: str = Field(
        "frame-*.color.png",
        description="Colour files, relative to SOURCE; the text matched by * pairs the files of a frame.",
    )
    depth: str = Field(
        "frame-*.depth.png",
        description="Depth files: 16-bit PNG, PGM or TIFF; or floating point, in metres, as TIFF, EXR or .npy.",
    )
    cloud: str = Field(
        "", description="Instead of --depth: organised point clouds, PCD files; with colours, also instead of --color."
    )
    pose: str = Field(
        "frame-*.pose.txt",
        description="Pose files: 4x4 or 3x4 matrix, or tx ty tz qx qy qz qw. Without *: one file for all frames, with "
        "a pose per line, 4x4 blocks, Open3D's .log, a .npy (t, 4, 4), or TUM's lines `time tx ty tz qx qy qz qw`.",
    )
    pose_by: Literal["auto", "order", "number", "time"] = Field(
        "auto", description="How the poses in one file belong to frames: in order, or by what each begins with."
    )
    column_major: bool = Field(
        False, description="Matrices of poses are written column by column, the translation last."
    )
    intrinsics: Text = Field(
        "",
        description="Intrinsics: fx,fy,cx,cy in pixels, or a file: these 4 numbers or a 3x3 matrix, OpenCV's "
        "distortion after them or not; or JSON or YAML of OpenCV, ROS, Open3D. Clouds need none.",
    )
    intrinsics_size: IntrinsicsSize = ""
    depth_scale: DepthScale = None
    invalid_depth: InvalidDepth = ""
    fps: FiniteFloat = Field(30.0, gt=0, description="Frames per second: time is frame number / fps.")
    timestamps: str = Field(
        "",
        description="Instead of --fps: a text file with one time per line, or `name` if * matches the time.",
    )
    robot: str = Field(
        "",
        description="The robot's states and actions of a demonstration: a CSV file with a line for each frame, and "
        "columns named gripper_width (metres) or after the action's parts.",
        json_schema_extra={"file": True},
    )
