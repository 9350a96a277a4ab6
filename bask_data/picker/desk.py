"""What the page can do: look at frames, work on the draft, save it. Requests are checked, answers are plain data."""

from __future__ import annotations

import json
import struct
import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from bask_data.errors import UsageError
from bask_data.picker.draft import Draft, Mark
from bask_data.picker.gallery import FrameName, Gallery

if TYPE_CHECKING:
    import torch

MOST_FRAMES = 24
"""Frames that one request may ask for."""


class Request(BaseModel):
    """What the page asks for; a field too many is an error."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class ForFrame(Request):
    """Something of a frame."""

    frame: FrameName


class Place(Request):
    """A pixel of a frame's image."""

    frame: FrameName
    u: float
    v: float


class ForHeat(Request):
    """Where a pixel is found again."""

    at: Place
    frames: tuple[FrameName, ...] = Field(max_length=MOST_FRAMES)


class ForMatches(Request):
    """Where all keypoints are found."""

    frames: tuple[FrameName, ...] = Field(max_length=MOST_FRAMES)


class Edit(Request):
    """One step of work on the draft."""

    do: Literal["add", "move", "rename", "delete", "clear", "undo", "redo"]
    name: str = Field("", max_length=200)
    new_name: str = Field("", max_length=200)
    at: Place | None = None


class ForProposals(Request):
    """Keypoints chosen automatically on the objects of a scan."""

    scene: str = Field(max_length=100)
    n: int = Field(16, ge=1, le=64)


class Nothing(Request):
    """No more than the wish."""


class Desk:
    """The dataset's frames, the draft, and the ways to propose and to save keypoints.

    Args:
        propose: gives keypoints chosen automatically in a scene.
        save: makes the artifact of the marks; gives a line about it, and the next command.
        title: of the page.
    """

    def __init__(
        self,
        gallery: Gallery,
        draft: Draft,
        *,
        propose: Callable[[str, int], list[Mark]],
        save: Callable[[tuple[Mark, ...]], tuple[str, str]],
        title: str,
    ) -> None:
        self.gallery, self.draft, self.title = gallery, draft, title
        self._propose, self._save = propose, save
        self._saved: tuple[Mark, ...] | None = None
        self._editing = threading.Lock()
        self._descriptors: dict[Mark, torch.Tensor] = {}

    def start(self, asked: Nothing) -> dict[str, Any]:
        """What a page needs that has just been opened."""
        return {"title": self.title, "recordings": self.gallery.listed(), **self.state()}

    def state(self) -> dict[str, Any]:
        """The draft."""
        draft = self.draft
        return {
            "marks": [mark.model_dump() for mark in draft.marks],
            "can_undo": draft.can_undo,
            "can_redo": draft.can_redo,
            "is_saved": self._saved == draft.marks,
        }

    def edit(self, asked: Edit) -> dict[str, Any]:
        """Work on the draft, one request at a time."""
        with self._editing:
            if asked.do in ("add", "move"):
                self._place(asked)
            elif asked.do == "rename":
                self.draft.rename(asked.name, asked.new_name)
            elif asked.do == "delete":
                self.draft.delete([asked.name])
            elif asked.do == "clear":
                self.draft.delete([mark.name for mark in self.draft.marks])
            elif asked.do == "undo":
                self.draft.undo()
            else:
                self.draft.redo()
            return self.state()

    def _place(self, asked: Edit) -> None:
        if asked.at is None:
            raise UsageError("edit", "at", expected="a pixel", got="none")
        frame, u, v = asked.at.frame, round(asked.at.u, 1), round(asked.at.v, 1)
        self.gallery.check_pixel(frame, u, v)
        if asked.do == "add":
            self.draft.add([Mark(name=asked.name, **frame._asdict(), u=u, v=v)])
        else:
            mark = self.draft.find(asked.name)
            if frame_of(mark) != frame:
                raise UsageError("edit", "at", expected="a pixel of the keypoint's own frame", got=str(frame))
            self.draft.move(asked.name, u, v)

    def describe(self, asked: ForFrame) -> dict[str, Any]:
        """Make a frame ready to be searched."""
        self.gallery.describe(asked.frame)
        return {"described": True}

    def picture(self, asked: ForFrame) -> bytes:
        """A frame as JPEG."""
        return self.gallery.picture(asked.frame)

    def heat(self, asked: ForHeat) -> bytes:
        """Heat maps of a pixel in those of the frames that are described already.

        Returns:
            the length of a JSON text as uint32, little-endian; the text; one byte a pixel for each map, row by row. A
            byte b stands for the distance `scale` (b / 255)^2: near zero, where it matters, steps are small.
        """
        import numpy as np

        at = asked.at
        descriptor = self.gallery.descriptor_at(at.frame, at.u, at.v)
        # A frame may be asked for twice, as two views may show it.
        ready = dict.fromkeys(frame for frame in asked.frames if self.gallery.is_described(frame))
        found = {frame: self.gallery.find(descriptor, frame) for frame in ready}
        scale = max((float(one.z.max()) for one in found.values()), default=0.0) or 1.0
        places = self.gallery.same_place(at.frame, at.u, at.v, asked.frames)
        # What most pixels are like is not what is looked for: it sets the colours' range. A few of them tell.
        few = [one.z.ravel()[:: max(one.z.size // 1000, 1)] for one in found.values()]
        middle = float(np.median(np.concatenate(few))) if few else scale
        header = {
            "scale": scale,
            "middle": middle or scale,
            "maps": [
                {"size": found[frame].z.shape, "best": found[frame].best, "z": found[frame].z_best, "place": place}
                if frame in found
                else None
                for frame, place in zip(asked.frames, places, strict=True)
            ],
        }
        text = json.dumps(header).encode()
        maps = [found[frame].z for frame in asked.frames if frame in found]
        codes = [np.rint(255 * np.sqrt(z / scale)).astype(np.uint8).tobytes() for z in maps]
        return b"".join([struct.pack("<I", len(text)), text, *codes])

    def matches(self, asked: ForMatches) -> dict[str, Any]:
        """Where each keypoint is found in those of the frames that are described already, and how far off."""
        marks = self.draft.marks
        self._descriptors = {mark: self._descriptor(mark) for mark in marks}
        found: list[list[list[float]] | None] = []
        for frame in asked.frames:
            if self.gallery.is_described(frame):
                best = [self.gallery.find(self._descriptors[mark], frame) for mark in marks]
                found.append([[*one.best, one.z_best] for one in best])
            else:
                found.append(None)
        return {"names": [mark.name for mark in marks], "frames": found}

    def _descriptor(self, mark: Mark) -> torch.Tensor:
        known = self._descriptors.get(mark)
        return self.gallery.descriptor_at(frame_of(mark), mark.u, mark.v) if known is None else known

    def propose(self, asked: ForProposals) -> dict[str, Any]:
        """Add keypoints chosen automatically, as one step."""
        proposed = self._propose(asked.scene, asked.n)
        with self._editing:
            self.draft.add(proposed)
            return self.state()

    def save(self, asked: Nothing) -> dict[str, Any]:
        """Make the artifact of the draft's keypoints."""
        with self._editing:
            marks = self.draft.marks
            if not marks:
                raise UsageError("save", "", expected="a keypoint", got="none", fix="click on one first.")
            told, following = self._save(marks)
            self._saved = marks
            return {"told": told, "next": following, **self.state()}


def frame_of(mark: Mark) -> FrameName:
    """The frame a keypoint was marked in."""
    return FrameName(mark.recording, mark.camera, mark.frame)
