"""Options of `ingest apc`."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, FiniteFloat

from bask_data.formats.options.common import SourceOptions
from bask_data.params import NAME


class ApcOptions(SourceOptions):
    """A scene of the MIT-Princeton team's recordings for the Amazon Picking Challenge."""

    camera: str = Field("wrist", pattern=NAME, description="Name of the camera in the dataset.")
    world: Literal["auto", "bin", "robot"] = Field(
        "auto", description="World frame: the shelf bin's, the robot's, or the bin's if the files state it (auto)."
    )
    fps: FiniteFloat = Field(1.0, gt=0, description="Frames per second: time is frame number / fps.")
