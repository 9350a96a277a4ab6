"""Options of `ingest tum`."""

from __future__ import annotations

from pydantic import Field, FiniteFloat

from bask_data.formats.options.common import IntrinsicsSize, PoseOptions, StampOptions, Text
from bask_data.params import NAME


class TumOptions(PoseOptions, StampOptions):
    """A sequence in the layout of the TUM RGB-D benchmark."""

    camera: str = Field("camera", pattern=NAME, description="Name of the camera in the dataset: wrist, overhead.")
    intrinsics: Text = Field(
        "",
        description="freiburg1, freiburg2 or freiburg3: the benchmark's calibration; or fx,fy,cx,cy, or a file.",
    )
    intrinsics_size: IntrinsicsSize = ""
    depth_scale: FiniteFloat = Field(0.0002, gt=0, description="Metres per unit of the depth files.")
    trajectory: str = Field(
        "groundtruth.txt",
        description="File of the poses, lines `timestamp tx ty tz qx qy qz qw`: also what SLAM systems write, such as "
        "ORB-SLAM's CameraTrajectory.txt.",
    )
    associations: str = Field(
        "", description="File that pairs colour and depth, lines `time file time file`, instead of rgb.txt, depth.txt."
    )
    max_time_difference: FiniteFloat = Field(
        0.02, gt=0, description="Largest difference in seconds between a colour image and its depth."
    )
