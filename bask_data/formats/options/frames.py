"""Options of `ingest frames`."""

from __future__ import annotations

from pydantic import Field, FiniteFloat

from bask_data.formats.options.common import PoseOptions, Text
from bask_data.params import NAME, SIZE, WHOLE_NUMBERS


class FramesOptions(PoseOptions):
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
    fps: FiniteFloat = Field(30.0, gt=0, description="Frames per second: time is frame number / fps.")
    timestamps: str = Field(
        "",
        description="Instead of --fps: a text file with one time in seconds per line, or `name` if * matches the time.",
    )
