"""Options of `ingest bop`."""

from __future__ import annotations

from pydantic import Field

from bask_data.formats.options.common import EpisodeOptions, OneCameraOptions, TimeOptions


class BopOptions(OneCameraOptions, TimeOptions, EpisodeOptions):
    """A scene of a data set in BOP's layout, or of YCB-Video in its own."""

    sensor: str = Field("", description="Which of a scene's sensors to read, where it has several: cam1, photoneo.")
    world_object: int | None = Field(
        None,
        ge=0,
        description="Object id whose frame is the world, for a static scene whose files state no camera poses.",
    )
