"""Options of `ingest nerfstudio`."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from bask_data.formats.options.common import OneCameraOptions, TimeOptions


class NerfstudioOptions(OneCameraOptions, TimeOptions):
    """A folder with transforms.json, as nerfstudio and Instant-NGP read it, with depth."""

    transforms: str = Field("transforms.json", description="The file with the frames, relative to SOURCE.")
    depth_scale: float | None = Field(
        None,
        gt=0,
        allow_inf_nan=False,
        description="Metres per unit of the depth files; by default integer_depth_scale of the file, or 0.001 as in "
        "nerfstudio.",
    )
    axes: Literal["opengl", "opencv"] = Field(
        "opengl", description="Camera axes of transform_matrix: nerfstudio's, or opencv, as some scripts write them."
    )
    world: Literal["source", "file"] = Field(
        "source",
        description="World frame: the source's, with applied_transform and applied_scale undone, or the file's.",
    )
