"""What the page can do: look at frames, work on the draft, save it. Requests are checked, answers are plain data."""

from __future__ import annotations

import json
import struct
import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from bask_data.errors import UsageError
from bask_data.picker.draft import Draft, KeypointMark
from bask_data.picker.gallery import FrameName, Gallery
from bask_data.picker.jobs import Cancelled, Jobs
from bask_data.picker.requests import (
    EditRequest,
    EmptyRequest,
    FrameRequest,
    HeatRequest,
    MatchesRequest,
    ProposalRequest,
)

if TYPE_CHECKING:
    import torch


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
        propose: Callable[[str, int], list[KeypointMark]],
        save: Callable[[tuple[KeypointMark, ...]], tuple[str, str]],
        title: str,
    ) -> None:
        self.gallery, self.draft, self.title = gallery, draft, title
        self._propose, self._save = propose, save
        self._saved: tuple[KeypointMark, ...] | None = None
        self.jobs = Jobs()
        self._editing = threading.Lock()
        self._descriptors: dict[KeypointMark, torch.Tensor] = {}

    def start(self, request: EmptyRequest) -> dict[str, Any]:
        """What a page needs that has just been opened."""
        return {
            "title": self.title,
            "recordings": self.gallery.listed(),
            "job": self.jobs.state(),
            **self.state(),
        }

    def state(self) -> dict[str, Any]:
        """The draft."""
        draft = self.draft
        return {
            "marks": [mark.model_dump() for mark in draft.marks],
            "can_undo": draft.can_undo,
            "can_redo": draft.can_redo,
            "is_saved": self._saved == draft.marks,
        }

    def edit(self, request: EditRequest) -> dict[str, Any]:
        """Work on the draft, one request at a time."""
        with self._editing:
            if request.do in ("add", "move"):
                self._place(request)
            elif request.do == "rename":
                self.draft.rename(request.name, request.new_name)
            elif request.do == "delete":
                self.draft.delete([request.name])
            elif request.do == "clear":
                self.draft.delete([mark.name for mark in self.draft.marks])
            elif request.do == "undo":
                self.draft.undo()
            else:
                self.draft.redo()
            return self.state()

    def _place(self, request: EditRequest) -> None:
        if request.at is None:
            raise UsageError("edit", "at", expected="a pixel", got="none")
        frame, u, v = request.at.frame, round(request.at.u, 1), round(request.at.v, 1)
        self.gallery.check_pixel(frame, u, v)
        if request.do == "add":
            self.draft.add([KeypointMark(name=request.name, **frame._asdict(), u=u, v=v)])
        else:
            mark = self.draft.find(request.name)
            if frame_of(mark) != frame:
                raise UsageError("edit", "at", expected="a pixel of the keypoint's own frame", got=str(frame))
            self.draft.move(request.name, u, v)

    def describe(self, request: FrameRequest) -> dict[str, Any]:
        """Make a frame ready to be searched."""
        self.gallery.describe(request.frame)
        return {"described": True}

    def picture(self, request: FrameRequest) -> bytes:
        """A frame as JPEG."""
        return self.gallery.picture(request.frame)

    def heat(self, request: HeatRequest) -> bytes:
        """Heat maps of a pixel in those of the frames that are described already.

        Returns:
            the length of a JSON text as uint32, little-endian; the text; one byte a pixel for each map, row by row. A
            byte b stands for the distance `scale` (b / 255)^2: near zero, where it matters, steps are small.
        """
        import numpy as np

        at = request.at
        descriptor = self.gallery.descriptor_at(at.frame, at.u, at.v)
        # A frame may be request for twice, as two views may show it.
        ready = dict.fromkeys(frame for frame in request.frames if self.gallery.is_described(frame))
        found = {frame: self.gallery.find(descriptor, frame) for frame in ready}
        scale = max((float(one.z.max()) for one in found.values()), default=0.0) or 1.0
        places = self.gallery.same_place(at.frame, at.u, at.v, request.frames)
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
                for frame, place in zip(request.frames, places, strict=True)
            ],
        }
        text = json.dumps(header).encode()
        maps = [found[frame].z for frame in request.frames if frame in found]
        codes = [np.rint(255 * np.sqrt(z / scale)).astype(np.uint8).tobytes() for z in maps]
        return b"".join([struct.pack("<I", len(text)), text, *codes])

    def matches(self, request: MatchesRequest) -> dict[str, Any]:
        """Where each keypoint is found in those of the frames that are described already, and how far off."""
        marks = self.draft.marks
        self._descriptors = {mark: self._descriptor(mark) for mark in marks}
        found: list[list[list[float]] | None] = []
        for frame in request.frames:
            if self.gallery.is_described(frame):
                best = [self.gallery.find(self._descriptors[mark], frame) for mark in marks]
                found.append([[*one.best, one.z_best] for one in best])
            else:
                found.append(None)
        return {"names": [mark.name for mark in marks], "frames": found}

    def _descriptor(self, mark: KeypointMark) -> torch.Tensor:
        known = self._descriptors.get(mark)
        return self.gallery.descriptor_at(frame_of(mark), mark.u, mark.v) if known is None else known

    def propose(self, request: ProposalRequest) -> dict[str, Any]:
        """Add keypoints chosen automatically, as one step; none if it is cancelled meanwhile."""
        try:
            with self.jobs.running("propose", can_cancel=True):
                proposed = self._propose(request.scene, request.n)
        except Cancelled:
            return {"is_cancelled": True, **self.state()}
        with self._editing:
            self.draft.add(proposed)
            return {"is_cancelled": False, **self.state()}

    def save(self, request: EmptyRequest) -> dict[str, Any]:
        """Make the artifact of the draft's keypoints."""
        with self.jobs.running("save", can_cancel=False), self._editing:
            marks = self.draft.marks
            if not marks:
                raise UsageError("save", "", expected="a keypoint", got="none", fix="click on one first.")
            told, following = self._save(marks)
            self._saved = marks
            return {"told": told, "next": following, **self.state()}

    def progress(self, request: EmptyRequest) -> dict[str, Any]:
        """How far the job is that runs."""
        return {"job": self.jobs.state()}

    def cancel(self, request: EmptyRequest) -> dict[str, Any]:
        """End the job that runs, if it can be cancelled."""
        self.jobs.cancel()
        return self.progress(request)


def frame_of(mark: KeypointMark) -> FrameName:
    """The frame a keypoint was marked in."""
    return FrameName(mark.recording, mark.camera, mark.frame)
