"""What the page may ask its server for, each request a model that refuses what it does not know."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from bask_data.picker.gallery import FrameName

MOST_FRAMES = 24
"""Frames that one request may ask for. The page shows seven; the bound keeps a request short (a frame takes 5 ms to
search with 64 dimensions at 256x256), and may as well be twice or half of that."""


class Request(BaseModel):
    """What the page asks for; a field too many is an error."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class FrameRequest(Request):
    """A frame that something is wanted of."""

    frame: FrameName


class FramePixel(Request):
    """A pixel of a frame's image."""

    frame: FrameName
    u: float
    v: float


class HeatRequest(Request):
    """A pixel, and the frames to look for it in."""

    at: FramePixel
    frames: tuple[FrameName, ...] = Field(max_length=MOST_FRAMES)


class MatchesRequest(Request):
    """Frames to look for all keypoints in."""

    frames: tuple[FrameName, ...] = Field(max_length=MOST_FRAMES)


class EditRequest(Request):
    """One step of work on the draft."""

    do: Literal["add", "move", "rename", "delete", "clear", "undo", "redo"]
    name: str = Field("", max_length=200)
    new_name: str = Field("", max_length=200)
    at: FramePixel | None = None


class ProposalRequest(Request):
    """Keypoints chosen automatically on the objects of a scan."""

    scene: str = Field(max_length=100)
    n: int = Field(16, ge=1, le=64)


class EmptyRequest(Request):
    """A request without fields."""
