"""Options of `ingest polycam`."""

from __future__ import annotations

from pydantic import Field

from bask_data.formats.options.common import OneCameraOptions


class PolycamOptions(OneCameraOptions):
    """Raw data that Polycam exports of a LiDAR capture (developer mode)."""

    least_blur_score: float | None = Field(
        None,
        allow_inf_nan=False,
        description="Leave out keyframes whose blur_score is below this: the smaller, the blurrier. By default none.",
    )
