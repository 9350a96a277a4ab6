"""Frames that cannot be used: found before anything is written, and refused or left out."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

import numpy as np

from bask_data.core.geometry import rigid_fault
from bask_data.errors import BadData, UsageError
from bask_data.formats.files import listed
from bask_data.formats.options.common import SourceOptions
from bask_data.formats.poses import ROUNDED_TOLERANCE
from bask_data.formats.recording import SourceCamera


@dataclass(frozen=True)
class Bad:
    """A frame that cannot be used.

    Args:
        kind: why, in one or two words.
        error: what is raised if frames may not be left out.
        is_expected: whether the format itself has such frames, so that nobody needs to ask for leaving them out.
    """

    camera: str
    frame: str
    index: int
    kind: str
    error: BadData
    is_expected: bool = False

    @property
    def reason(self) -> str:
        """Why, in a sentence."""
        return self.error.fault


def chosen_frames(camera: SourceCamera, text: str) -> list[int]:
    """Indices of the frames that `--frames FIRST:END:STEP` chooses; all for an empty text."""
    n_frames = len(camera.frames)
    parts = [int(part) if part else None for part in text.split(":")] if text else [None, None]
    if len(parts) == 1:
        parts = [parts[0], int(text) + 1]
    chosen = list(range(n_frames))[slice(*parts)]
    if not chosen:
        raise UsageError("--frames", expected=f"frames of {camera.name} among 0 to {n_frames - 1}", got=text)
    return chosen


def bad_frames(camera: SourceCamera, chosen: list[int], options: SourceOptions) -> Iterator[Bad]:
    """The frames among the chosen ones that cannot be used.

    Poses are always looked at. Images are read twice only if bad ones are to be left out; otherwise the first one stops
    the reading.
    """
    for i in chosen:
        if i in camera.faults:
            kind = camera.expected.get(i, "incomplete")
            yield Bad(camera.name, camera.frames[i], i, kind, camera.faults[i], i in camera.expected)
        elif fault := rigid_fault(camera.world_from_cameras[i], ROUNDED_TOLERANCE):
            finite = bool(np.isfinite(camera.world_from_cameras[i]).all())
            lost = BadData(
                camera.pose_place(i),
                "pose",
                expected="a rigid transform",
                got=fault,
                fix="convert the poses if their convention differs."
                if finite
                else "pass --skip-bad to leave out the frames whose pose was lost.",
            )
            yield Bad(camera.name, camera.frames[i], i, "no rigid pose" if finite else "no pose", lost)
        elif options.skip_bad:
            try:
                camera.color(i)
                has_depth = bool((np.nan_to_num(camera.depth(i)) > 0).any())
                if options.confidence is not None and camera.confidence is not None:
                    camera.confidence(i)
            except BadData as error:
                yield Bad(camera.name, camera.frames[i], i, "unreadable", error)
                continue
            if not has_depth:
                empty = BadData(
                    f"{camera.name} {camera.frames[i]}", "depth", expected="a measurement", got="none in the image"
                )
                yield Bad(camera.name, camera.frames[i], i, "no depth", empty)


def refuse(source: Path, bad: list[Bad]) -> NoReturn:
    """Raise the first fault, with the names of the further frames."""
    first = bad[0].error
    if len(bad) > 1:
        first.add_note(f"also: {listed([f'{fault.frame} ({fault.kind})' for fault in bad[1:]])}")
    if "--skip-bad" not in first.fix:
        these = f"all {len(bad)} of these frames" if len(bad) > 1 else "this frame"
        first.add_note(f"{source}: --skip-bad leaves out {these}")
    raise first
