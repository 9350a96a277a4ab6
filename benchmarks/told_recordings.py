"""Real recordings told in all readings, right and wrong: for `doctor_statistics.py --recordings TABLE`.

A table has a line for each recording, as `ingest` is called: its folder, the format, and the right options.
"""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from bask_data.formats import FORMATS
from bask_data.formats.recording import CameraRecording
from benchmarks.told_readings import Told, Wrong, told_frames

LEAST_FRAMES = 12
"""Of a recording whose clock is told wrong: some frames at both ends are lost."""

MOST_LAG = 3
"""Frames that a clock is told wrong by."""

SINGLE = {
    "as it is": Wrong(),
    "millimetres": Wrong(pose_factor=1000.0),
    "quaternions": Wrong(reordered=True),
    "rays": Wrong(is_ray=True),
    "handedness": Wrong(mirrored=True),
    "half K": Wrong(K_factor=(0.5, 0.5)),
    "double K": Wrong(K_factor=(2.0, 2.0)),
    "K of 4:3 for 16:9": Wrong(K_factor=(0.5, 2 / 3)),
}
"""One thing told wrong."""

UNITS = (1.0, 10.0, 0.1, 1000.0, 0.001, 0.2, 5.0)
"""Told depth per true depth, with each of the four readings of poses."""


@dataclass(frozen=True)
class Line:
    """A recording and how it is read rightly."""

    source: Path
    format: str
    options: dict[str, Any]


def read_table(table: Path) -> list[Line]:
    """The lines of a table; empty ones and those that begin with # say nothing."""
    return [_line(words) for text in table.read_text().splitlines() if (words := shlex.split(text, comments=True))]


def told_recordings(line: Line) -> Iterator[tuple[str, str, Told]]:
    """Each camera of a recording under each reading: the camera, what is told, and the frames."""
    format = next(each for each in FORMATS if each.name == line.format)
    options = format.options.model_validate(line.options | {"trust": True})
    for camera in format.read(line.source, options).cameras:
        name = f"{line.source.parent.name}/{line.source.name}/{camera.name}"
        for case, wrong in _cases():
            yield name, case, _told(camera, wrong)
        if camera.n_frames >= LEAST_FRAMES + 2 * MOST_LAG:
            for lag in range(-MOST_LAG, MOST_LAG + 1):
                if lag:
                    yield name, f"clock {lag}", _told(camera, Wrong(lag=lag))


def _cases() -> Iterator[tuple[str, Wrong]]:
    yield from SINGLE.items()
    for inverted, opengl, factor in product((False, True), (False, True), UNITS):
        if inverted or opengl or factor != 1.0:
            wrong = Wrong(inverted=inverted, opengl=opengl, depth_factor=factor)
            yield str(wrong), wrong


def _told(camera: CameraRecording, wrong: Wrong) -> Told:
    """A camera's frames; where the clock is told wrong, without those that would have no pose."""
    read = _kept(camera)
    if not wrong.lag:
        return told_frames(camera.n_frames, read, camera.Ks, camera.world_from_cameras, wrong)
    inner = np.arange(MOST_LAG, camera.n_frames - MOST_LAG)
    as_told = told_frames(
        len(inner),
        lambda i: read(int(inner[i])),
        camera.Ks[inner],
        camera.world_from_cameras[inner + wrong.lag],
        wrong,
    )
    return replace(as_told, wrong=wrong)


@lru_cache(maxsize=4)
def _frames(read: Any, scale: float) -> Any:
    """A reader of depth in metres that keeps what it decoded."""

    @lru_cache(maxsize=200)
    def depth(i: int) -> Float32[ndarray, "h w"]:
        return read(i) * np.float32(scale)

    return depth


def _kept(camera: CameraRecording) -> Any:
    return _frames(camera.read_depth, camera.depth_scale)


def _line(words: list[str]) -> Line:
    source, name, *rest = words
    options: dict[str, Any] = {}
    for k, word in enumerate(rest):
        if word.startswith("--"):
            has_value = k + 1 < len(rest) and not rest[k + 1].startswith("--")
            options[word[2:].replace("-", "_")] = rest[k + 1] if has_value else True
    return Line(Path(source), name, options)
