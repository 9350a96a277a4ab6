"""Operations of the page: show frames, edit the draft, save it. Requests are validated; answers are plain data."""

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
    """The dataset's frames, the draft, and how keypoints are proposed and saved.

    Args:
        propose: returns n automatic keypoints of a scene.
        save: makes the artifact from the marks; returns a line about it, and the next command.
        title: title of the page.
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
        """Initial data of a page: title, recordings, running job and draft."""
        return {
            "title": self.title,
            "recordings": self.gallery.listed(),
            "job": self.jobs.state(),
            **self.state(),
        }

    def state(self) -> dict[str, Any]:
        """The draft: its marks, whether a step can be undone or redone, and whether it is saved."""
        draft = self.draft
        return {
            "marks": [mark.model_dump() for mark in draft.marks],
            "can_undo": draft.can_undo,
            "can_redo": draft.can_redo,
            "is_saved": self._saved == draft.marks,
        }

    def edit(self, request: EditRequest) -> dict[str, Any]:
        """Apply one step to the draft; concurrent requests wait."""
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
        """Compute a frame's descriptors, so that it can be searched."""
        self.gallery.describe(request.frame)
        return {"described": True}

    def picture(self, request: FrameRequest) -> bytes:
        """A frame's colour image as JPEG."""
        return self.gallery.picture(request.frame)

    def heat(self, request: HeatRequest) -> bytes:
        """Distance maps of a pixel's descriptor, for the requested frames whose descriptors are computed.

        Returns:
            the length of a JSON header as little-endian uint32; the header; then each map row by row, one byte per
            pixel. A byte b stands for the distance `scale` (b / 255)^2, so that small distances have small steps.
        """
        import numpy as np

        at = request.at
        descriptor = self.gallery.descriptor_at(at.frame, at.u, at.v)
        # Two views may show the same frame.
        ready = dict.fromkeys(frame for frame in request.frames if self.gallery.is_described(frame))
        searched = {frame: self.gallery.find(descriptor, frame) for frame in ready}
        scale = max((float(result.z.max()) for result in searched.values()), default=0.0) or 1.0
        places = self.gallery.same_place(at.frame, at.u, at.v, request.frames)
        # The median distance, estimated from a sample, sets the range of the colours: most pixels are no match.
        samples = [result.z.ravel()[:: max(result.z.size // 1000, 1)] for result in searched.values()]
        middle = float(np.median(np.concatenate(samples))) if samples else scale
        maps = [
            {"size": searched[frame].z.shape, "best": searched[frame].best, "z": searched[frame].z_best, "place": place}
            if frame in searched
            else None
            for frame, place in zip(request.frames, places, strict=True)
        ]
        text = json.dumps({"scale": scale, "middle": middle or scale, "maps": maps}).encode()
        distances = [searched[frame].z for frame in request.frames if frame in searched]
        codes = [np.rint(255 * np.sqrt(z / scale)).astype(np.uint8).tobytes() for z in distances]
        return b"".join([struct.pack("<I", len(text)), text, *codes])

    def matches(self, request: MatchesRequest) -> dict[str, Any]:
        """Best match (u, v, distance) of each keypoint in each requested frame; None without descriptors."""
        marks = self.draft.marks
        # Its own: another request with other marks may replace the desk's meanwhile.
        descriptors = self._descriptors = {mark: self._descriptor(mark) for mark in marks}
        matches: list[list[list[float]] | None] = []
        for frame in request.frames:
            if self.gallery.is_described(frame):
                results = [self.gallery.find(descriptors[mark], frame) for mark in marks]
                matches.append([[*result.best, result.z_best] for result in results])
            else:
                matches.append(None)
        return {"names": [mark.name for mark in marks], "frames": matches}

    def _descriptor(self, mark: KeypointMark) -> torch.Tensor:
        known = self._descriptors.get(mark)
        return self.gallery.descriptor_at(frame_of(mark), mark.u, mark.v) if known is None else known

    def propose(self, request: ProposalRequest) -> dict[str, Any]:
        """Add automatic keypoints as one step; none if the job is cancelled."""
        try:
            with self.jobs.running("propose", can_cancel=True):
                proposed = self._propose(request.scene, request.n)
        except Cancelled:
            return {"is_cancelled": True, **self.state()}
        with self._editing:
            self.draft.add(proposed)
            return {"is_cancelled": False, **self.state()}

    def save(self, request: EmptyRequest) -> dict[str, Any]:
        """Make the artifact from the draft; `UsageError` without keypoints."""
        with self.jobs.running("save", can_cancel=False):
            with self._editing:
                marks = self.draft.marks
            if not marks:
                raise UsageError("save", "", expected="a keypoint", got="none", fix="click on one first.")
            # The draft is free meanwhile: each click that waited for it would occupy a thread of the server.
            summary, following = self._save(marks)
            with self._editing:
                self._saved = marks
                self.draft.drop(marks)
                return {"summary": summary, "next": following, **self.state()}

    def progress(self, request: EmptyRequest) -> dict[str, Any]:
        """State of the running job."""
        return {"job": self.jobs.state()}

    def cancel(self, request: EmptyRequest) -> dict[str, Any]:
        """Cancel the running job, if it allows it."""
        self.jobs.cancel()
        return self.progress(request)


def frame_of(mark: KeypointMark) -> FrameName:
    """The frame in which a keypoint was picked."""
    return FrameName(mark.recording, mark.camera, mark.frame)
