"""Options that many formats share: every model of a format's options derives from `SourceOptions`.

They import neither NumPy nor OpenCV, so that `--help` stays fast.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BeforeValidator, Field, FiniteFloat

from bask_data.params import FRAMES, NAME, SIZE, WHOLE_NUMBERS, Params

Text = Annotated[str, BeforeValidator(lambda value: str(value) if isinstance(value, int | float) else value)]
"""A text that may be a number in a configuration file: `invalid_depth: 65535`."""


PoseIs = Literal["world_from_camera", "camera_from_world"]
Axes = Literal["opencv", "opengl"]


IntrinsicsSize = Annotated[
    str,
    Field(
        pattern=SIZE,
        description="WIDTHxHEIGHT of the images used to calibrate the intrinsics; checked against the files.",
    ),
]
"""Size that intrinsics are for; empty: not stated."""

DepthScale = Annotated[
    FiniteFloat | None,
    Field(
        gt=0,
        description="Metres per unit of the depth files: 0.001 for millimetres, 0.0002 for TUM's. Unless set, 0.001 "
        "for whole numbers and 1 for floating point.",
    ),
]
"""Unit of depth in files that may hold whole numbers or floating point."""

InvalidDepth = Annotated[
    Text,
    Field(
        pattern=WHOLE_NUMBERS,
        description="Raw depth values besides 0 that mean no measurement, separated by commas: 65535.",
    ),
]
"""Values of raw depth that mean none."""


class SourceOptions(Params):
    """What can be asked of any recording; `prepare` does it, readers need not."""

    frames: Text = Field(
        "", pattern=FRAMES, description="Frames to read, as FIRST:END:STEP over the sorted frames: 10:500:2, ::5, :100."
    )
    skip_bad: bool = Field(
        False,
        description="Leave out frames that cannot be used (lost tracking, no depth, unreadable); they are listed.",
    )
    follow_links: bool = Field(
        False, description="Read what links out of SOURCE stand for: DVC, git-annex, other discs. Content is copied."
    )
    labels: str = Field(
        "",
        description="Label images as ground truth, as a pattern whose * matches the frames' names: labels/*.png.",
    )
    confidence: int | None = Field(
        None, ge=0, description="Least confidence of depth to keep, where the source has confidence maps."
    )
    align: Literal["auto", "color", "depth"] = Field(
        "auto",
        description="Whose pixels are kept where depth and colour differ: colour's (depth is registered to them) or "
        "depth's (colour is resampled). auto: depth's if one camera gave both, otherwise colour's.",
    )
    depth_intrinsics: Text = Field(
        "",
        description="Intrinsics of the depth images, if they are not colour's: fx,fy,cx,cy, a text file, or `scaled`: "
        "colour's in another resolution.",
    )
    color_from_depth: str = Field(
        "",
        description="File with the pose of the depth camera in the colour camera: 4x4, or tx ty tz qx qy qz qw.",
        json_schema_extra={"file": True},
    )
    depth_is: Literal["z", "ray"] = Field(
        "z", description="What depth measures: along the optical axis (z, usual), or the length of the ray."
    )
    distortion: Text = Field(
        "",
        description="Lens distortion to take out, if the files do not state it: MODEL:NUMBERS, for instance "
        "opencv:k1,k2,p1,p2[,k3[,k4,k5,k6]], fisheye:k1,k2,k3,k4, or one of COLMAP's models.",
    )
    trust: bool = Field(
        False, description="Read as told, even if the depth of the frames supports another reading of poses or units."
    )
    local_origin: bool = Field(
        True, description="Move a world whose origin is far (UTM) near to the cameras; undone at export."
    )

    @classmethod
    def has(cls, name: str) -> bool:
        """Whether the format has an option, so that an error may offer it."""
        return name in cls.model_fields


class PoseOptions(SourceOptions):
    """How poses are written, for formats that leave it open."""

    pose_is: PoseIs = Field(
        "world_from_camera", description="Direction of the poses: camera to world (usual), or world to camera."
    )
    axes: Axes = Field(
        "opencv", description="Camera axes of the poses: opencv (y down, z forward) or opengl (y up, z backward)."
    )
    pose_unit: Literal["m", "cm", "mm"] = Field("m", description="Unit of the poses' translations.")
    quat: Literal["xyzw", "wxyz"] = Field("xyzw", description="Order of quaternions: qx qy qz qw, or qw qx qy qz.")
    gripper_from_camera: str = Field(
        "",
        description="Hand-eye calibration: a file with the camera's pose in the gripper. The poses are then the "
        "gripper's, world_from_gripper.",
        json_schema_extra={"file": True},
    )


class OneCameraOptions(SourceOptions):
    """A source of one camera, which has no name there."""

    camera: str = Field("camera", pattern=NAME, description="Name of the camera in the dataset: wrist, overhead.")


class EpisodeOptions(SourceOptions):
    """A source of many recordings."""

    episode: Text = Field(
        "",
        description="Which of the source's recordings to read, by name or number. Needed if there are several. "
        "`all`, or a range FIRST:END:STEP over all, reads each as NAME_EPISODE; --skip-bad goes on after a bad one.",
    )


class TimeOptions(SourceOptions):
    """Times that come from the number of frames."""

    fps: FiniteFloat = Field(30.0, gt=0, description="Frames per second: time is frame number / fps.")


class StampOptions(SourceOptions):
    """Times that the files state, of frames and of poses."""

    time_unit: Literal["auto", "s", "ms", "us", "ns"] = Field(
        "auto", description="Unit of time stamps; auto recognises and states it."
    )
    max_pose_gap: FiniteFloat = Field(
        0.1,
        ge=0,
        description="Poses at other times than the frames' are interpolated between two that are at most this many "
        "seconds apart.",
    )
