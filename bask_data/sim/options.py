"""Options of the simulator; descriptions are the help of `bask-data ingest sim`."""

from __future__ import annotations

from typing import Literal, get_args

from pydantic import Field, FiniteFloat, model_validator

from bask_data.params import Params

TaskName = Literal["microwave", "lid", "phone", "rubbish", "drawer", "mug"]
TASKS: tuple[TaskName, ...] = get_args(TaskName)
CameraName = Literal["wrist", "overhead"]
CAMERAS: tuple[CameraName, ...] = get_args(CameraName)
MAX_CLUTTER = 12
"""Most further objects on the table, limited by its size with objects `GAP` apart. Chosen."""


class SimOptions(Params):
    """A task, its objects, the cameras, and the defects of the recordings."""

    task: TaskName = Field(
        ...,
        description="microwave: close its door; lid: take it off its pan; phone: onto its base; rubbish: into a bin; "
        "drawer: pull it open; mug: onto a hook.",
    )
    seed: int = Field(
        0, ge=0, description="Seed of the objects' sizes and textures, and with the recording's number of their poses."
    )
    background_seed: int | None = Field(
        None, ge=0, description="Seed of another table and floor. Default: boards and tiles, by --seed."
    )
    distance_spread: FiniteFloat = Field(
        0.22, ge=0, le=0.6, description="Variation of a scan's camera distance, as a share of its mean; 0.6 is 4 to 1."
    )
    finished: FiniteFloat = Field(
        0.0, ge=0, le=1, description="Share of the scans that show the objects after the task."
    )
    cameras: tuple[CameraName, ...] = Field(
        ("wrist", "overhead"), min_length=1, description="Cameras, separated by commas."
    )
    frames: int = Field(60, ge=1, description="Frames of a scan; the length of a demonstration depends on the task.")
    height: int = Field(256, ge=16, le=4096, description="Height of the images, pixels.")
    width: int = Field(256, ge=16, le=4096, description="Width of the images, pixels.")
    overhead_height: int = Field(0, ge=0, le=4096, description="Height of the overhead camera's images; 0: --height.")
    overhead_width: int = Field(0, ge=0, le=4096, description="Width of the overhead camera's images; 0: --width.")
    clutter: int = Field(0, ge=0, le=MAX_CLUTTER, description="Further objects on the table.")
    depth_noise: FiniteFloat = Field(
        0.005, ge=0, le=0.02, description="Standard deviation of depth: this share of it plus 1 mm; 0 is exact."
    )
    flying: FiniteFloat = Field(
        0.0, ge=0, le=1, description="Share of the pixels at depth edges that are flying pixels."
    )
    holes: FiniteFloat = Field(
        0.0,
        ge=0,
        le=0.9,
        description="Share of pixels without depth, in patches, mostly at grazing angles and on glass.",
    )
    pose_noise: FiniteFloat = Field(
        0.0, ge=0, le=20, description="Noise of camera poses, in units of 2 mm and 0.2 degrees."
    )
    gripper_in_view: bool = Field(
        False, description="Show the moving fingers in the wrist camera's images during scans."
    )

    @model_validator(mode="after")
    def _names_once(self) -> SimOptions:
        if len(set(self.cameras)) != len(self.cameras):
            raise ValueError("each camera once")
        return self

    def size(self, camera: str) -> tuple[int, int]:
        """(height, width) of a camera's images, pixels."""
        if camera == "overhead":
            return self.overhead_height or self.height, self.overhead_width or self.width
        return self.height, self.width
