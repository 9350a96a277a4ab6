"""Options of the readers, one model per format; descriptions are the help of `bask-data ingest <format>`."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BeforeValidator, Field, FiniteFloat

from bask_data.params import NAME, SIZE, WHOLE_NUMBERS, Params

Text = Annotated[str, BeforeValidator(lambda value: str(value) if isinstance(value, int | float) else value)]
"""A text that may be a number in a configuration file: `invalid_depth: 65535`."""


class FramesOptions(Params):
    """A folder of colour, depth and pose files."""

    camera: str = Field("camera", pattern=NAME, description="Name of the camera in the dataset: wrist, overhead.")
    color: str = Field(
        "frame-*.color.png",
        description="Colour files, relative to SOURCE; the text matched by * pairs the files of a frame.",
    )
    depth: str = Field(
        "frame-*.depth.png", description="Depth files: 16-bit PNG or PGM, of the size of the colour images."
    )
    pose: str = Field(
        "frame-*.pose.txt",
        description="Pose files: 4x4 or 3x4 matrix, or tx ty tz qx qy qz qw. Without *: one file, one pose per line.",
    )
    intrinsics: Text = Field(
        "", description="Pinhole intrinsics: fx,fy,cx,cy in pixels, or a text file of 4 numbers or a 3x3 matrix."
    )
    intrinsics_size: str = Field(
        "",
        pattern=SIZE,
        description="WIDTHxHEIGHT of the images used to calibrate the intrinsics; checked against the files.",
    )
    depth_scale: FiniteFloat = Field(
        0.001, gt=0, description="Metres per unit of the depth files: 0.001 for millimetres, 0.0002 for TUM's."
    )
    invalid_depth: Text = Field(
        "",
        pattern=WHOLE_NUMBERS,
        description="Raw depth values besides 0 that mean no measurement, separated by commas: 65535.",
    )
    pose_is: Literal["world_from_camera", "camera_from_world"] = Field(
        "world_from_camera", description="Direction of the poses: camera to world (usual), or world to camera."
    )
    axes: Literal["opencv", "opengl"] = Field(
        "opencv", description="Camera axes of the poses: opencv (y down, z forward) or opengl (y up, z backward)."
    )
    fps: FiniteFloat = Field(30.0, gt=0, description="Frames per second: time is frame number / fps.")
    timestamps: str = Field(
        "",
        description="Instead of --fps: a text file with one time in seconds per line, or `name` if * matches the time.",
    )


class TumOptions(Params):
    """A sequence in the layout of the TUM RGB-D benchmark."""

    camera: str = Field("camera", pattern=NAME, description="Name of the camera in the dataset: wrist, overhead.")
    intrinsics: Text = Field(
        "",
        description="freiburg1, freiburg2 or freiburg3: the benchmark's calibration; or fx,fy,cx,cy, or a text file.",
    )
    intrinsics_size: str = Field(
        "",
        pattern=SIZE,
        description="WIDTHxHEIGHT of the images used to calibrate the intrinsics; checked against the files.",
    )
    depth_scale: FiniteFloat = Field(0.0002, gt=0, description="Metres per unit of the depth files.")
    max_time_difference: FiniteFloat = Field(
        0.02, gt=0, description="Largest difference in seconds between a colour image and its depth and pose."
    )


class ApcOptions(Params):
    """A scene of the MIT-Princeton team's recordings for the Amazon Picking Challenge."""

    camera: str = Field("wrist", pattern=NAME, description="Name of the camera in the dataset.")
    world: Literal["auto", "bin", "robot"] = Field(
        "auto", description="World frame: the shelf bin's, the robot's, or the bin's if the files state it (auto)."
    )
    fps: FiniteFloat = Field(1.0, gt=0, description="Frames per second: time is frame number / fps.")
