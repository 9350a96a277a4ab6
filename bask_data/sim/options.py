"""What can be asked of the simulator; each description is an option's help."""

from __future__ import annotations

from typing import Literal, get_args

from pydantic import Field, FiniteFloat, model_validator

from bask_data.params import Params

TaskName = Literal["microwave", "lid", "phone", "rubbish"]
TASKS: tuple[TaskName, ...] = get_args(TaskName)
CameraName = Literal["wrist", "overhead"]
CAMERAS: tuple[CameraName, ...] = get_args(CameraName)
MAX_CLUTTER = 12
"""Further objects on the table, at most: what it has room for, `GAP` apart. Chosen."""


class SimOptions(Params):
    """A task, its objects, the cameras, and the defects that the recordings shall have."""

    task: TaskName = Field(
        ...,
        description="microwave: close its door; lid: take it off a saucepan; phone: onto its base; rubbish: to bin.",
    )
    seed: int = Field(
        0, ge=0, description="Objects (size, texture) belong to the seed; where they stand, to seed and recording."
    )
    background_seed: int | None = Field(
        None, ge=0, description="Another table and floor, by this seed. Default: boards and tiles, by --seed."
    )
    distance_spread: FiniteFloat = Field(
        0.22, ge=0, le=0.6, description="Share by which the distance of a scan's camera varies: 0.6 is 4 to 1."
    )
    finished: FiniteFloat = Field(
        0.0, ge=0, le=1, description="Share of the scans that show the objects as the finished task leaves them."
    )
    cameras: tuple[CameraName, ...] = Field(("wrist", "overhead"), min_length=1, description="Cameras, by commas.")
    frames: int = Field(60, ge=1, description="Frames of a scan. A demonstration is as long as it takes.")
    height: int = Field(256, ge=16, le=4096, description="Height of the images, pixels.")
    width: int = Field(256, ge=16, le=4096, description="Width of the images, pixels.")
    overhead_height: int = Field(0, ge=0, le=4096, description="Height of the overhead camera's, 0: as the others'.")
    overhead_width: int = Field(0, ge=0, le=4096, description="Width of the overhead camera's, 0: as the others'.")
    clutter: int = Field(0, ge=0, le=MAX_CLUTTER, description="Further objects on the table.")
    depth_noise: FiniteFloat = Field(
        0.005, ge=0, le=0.02, description="Noise of depth, standard deviation: this share of it, and 1 mm; 0 is exact."
    )
    flying: FiniteFloat = Field(
        0.0, ge=0, le=1, description="Share of the pixels at depth edges that float between front and back."
    )
    holes: FiniteFloat = Field(
        0.0, ge=0, le=0.9, description="Share of the pixels without depth: in patches, at grazing angles, on glass."
    )
    pose_noise: FiniteFloat = Field(
        0.0, ge=0, le=20, description="Noise of the cameras' poses, in units of 2 mm and 0.2 degrees."
    )
    gripper_in_view: bool = Field(
        False, description="The fingers reach into the wrist camera's view while scanning, and move."
    )

    @model_validator(mode="after")
    def _names_once(self) -> SimOptions:
        if len(set(self.cameras)) != len(self.cameras):
            raise ValueError("each camera once")
        return self

    def size(self, camera: str) -> tuple[int, int]:
        """Height and width of a camera's images."""
        if camera == "overhead":
            return self.overhead_height or self.height, self.overhead_width or self.width
        return self.height, self.width
