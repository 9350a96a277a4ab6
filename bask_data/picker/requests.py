"""Requests of the page to its server, as strict models."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from bask_data.picker.gallery import FrameName

MOST_FRAMES = 24
"""Most frames of one request. The page shows at most nine; the bound limits the time of a request (searching a frame
of 256x256 pixels and 64 dimensions takes 5 ms), and half or twice as many would do."""


class Request(BaseModel):
    """A request of the page; unknown fields are errors."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class FrameRequest(Request):
    """A request about one frame."""

    frame: FrameName


class FramePixel(Request):
    """A pixel of a frame's image."""

    frame: FrameName
    u: float
    v: float


class HeatRequest(Request):
    """A pixel, and the frames in which to search for its descriptor."""

    at: FramePixel
    frames: tuple[FrameName, ...] = Field(max_length=MOST_FRAMES)


class MatchesRequest(Request):
    """Frames in which to search for all keypoints."""

    frames: tuple[FrameName, ...] = Field(max_length=MOST_FRAMES)


class EditRequest(Request):
    """One step of editing the draft."""

    do: Literal["add", "move", "rename", "delete", "clear", "undo", "redo"]
    name: str = Field("", max_length=200)
    new_name: str = Field("", max_length=200)
    at: FramePixel | None = None


class ProposalRequest(Request):
    """A request for n automatic keypoints on the objects of a scan."""

    scene: str = Field(max_length=100)
    n: int = Field(16, ge=1, le=64)


class EmptyRequest(Request):
    """A request without fields."""
