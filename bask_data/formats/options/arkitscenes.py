"""Options of `ingest arkitscenes`."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, FiniteFloat

from bask_data.formats.options.common import OneCameraOptions


class ArkitscenesOptions(OneCameraOptions):
    """A video of ARKitScenes, raw or of its 3D object detection set."""

    color: Literal["auto", "lowres_wide", "vga_wide", "wide"] = Field(
        "auto", description="Colour images to read: lowres_wide, vga_wide or wide; auto: the first one that is there."
    )
    depth: Literal["lowres_depth", "highres_depth"] = Field(
        "lowres_depth", description="Depth images to read: the phone's, or those of the laser scanner (highres_depth)."
    )
    max_pose_gap: FiniteFloat | None = Field(
        None,
        gt=0,
        description="Longest time in seconds between two poses that a frame's is interpolated between; 1.5 times the "
        "usual one if not given.",
    )
