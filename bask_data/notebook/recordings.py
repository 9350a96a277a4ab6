"""Recordings as sequences of frames."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, overload

from bask_data.errors import UsageError
from bask_data.kinds import Camera, Demonstration, Robot, Scan

if TYPE_CHECKING:
    import numpy as np

THUMBNAIL = 240
"""Pixels of the longer side of a picture in a notebook."""

Masks = Callable[[str, int], "np.ndarray"]
"""Gives the mask of a camera's frame."""


class RecordedFrame:
    """One frame of one camera; its arrays are read when they are asked for."""

    def __init__(self, camera: Camera, index: int, masks: Masks) -> None:
        self._camera, self._masks = camera, masks
        self.index = index
        """Number of the frame, from 0."""

    @property
    def camera(self) -> str:
        """Name of the camera."""
        return self._camera.name

    @cached_property
    def rgb(self) -> np.ndarray:
        """(h, w, 3) uint8, red, green, blue."""
        return self._camera.rgb(self.index)

    @cached_property
    def depth(self) -> np.ndarray:
        """z-depth (h, w) float32, metres; 0 means no measurement."""
        return self._camera.depth(self.index)

    @cached_property
    def mask(self) -> np.ndarray:
        """The visible object at each pixel (h, w) uint8; 0 is none.

        Raises:
            UsageError: no masks have been made of this recording.
        """
        return self._masks(self.camera, self.index)

    @property
    def K(self) -> np.ndarray:
        """Pinhole matrix (3, 3) float64, pixels; (0, 0) is the centre of the top-left pixel."""
        return self._camera.K

    @property
    def world_from_camera(self) -> np.ndarray:
        """(4, 4) float64, metres; camera x right, y down, z forward."""
        transform: np.ndarray = self._camera.world_from_cameras[self.index]
        return transform

    @property
    def time(self) -> float:
        """Seconds."""
        return float(self._camera.time[self.index])

    def __repr__(self) -> str:
        size = f"{self._camera.width}x{self._camera.height}"
        return f"<frame {self.index} of camera {self.camera}: {size}, {self.time:.2f} s>"

    def _repr_html_(self) -> str:
        return f"{picture_html(self.rgb)}<br><code>{escape(repr(self))}</code>"


class RecordedFrames(Sequence[RecordedFrame]):
    """The frames of one camera of a scan or demonstration: `len`, `[i]`, slices, and `for frame in ...`.

    Where there are several cameras, the first by name; `.camera(name)` gives another one.
    """

    def __init__(self, recording: Scan | Demonstration, masks: Masks, camera: str = "") -> None:
        self._recording, self._masks = recording, masks
        self.name = recording.path.name
        """Name of the scene or demonstration."""
        self._camera = recording.camera(camera or recording.camera_names[0])

    @property
    def cameras(self) -> list[str]:
        """Names of all cameras."""
        return self._recording.camera_names

    @property
    def robot(self) -> Robot | None:
        """What the robot did, in a demonstration that recorded it."""
        return self._recording.robot if isinstance(self._recording, Demonstration) else None

    def camera(self, name: str) -> RecordedFrames:
        """The frames of a camera.

        Raises:
            UsageError: there is no such camera.
        """
        if name not in self.cameras:
            raise UsageError(self._recording.path, "camera", expected=f"one of {', '.join(self.cameras)}", got=name)
        return RecordedFrames(self._recording, self._masks, name)

    def __len__(self) -> int:
        return self._camera.n_frames

    @overload
    def __getitem__(self, i: int) -> RecordedFrame: ...
    @overload
    def __getitem__(self, i: slice) -> list[RecordedFrame]: ...
    def __getitem__(self, i: int | slice) -> RecordedFrame | list[RecordedFrame]:
        if isinstance(i, slice):
            return [self[k] for k in range(*i.indices(len(self)))]
        if not -len(self) <= i < len(self):
            raise IndexError(f"{self.name}: frame: expected one of 0 to {len(self) - 1}, got {i}")
        return RecordedFrame(self._camera, i % len(self), self._masks)

    def __repr__(self) -> str:
        others = [name for name in self.cameras if name != self._camera.name]
        beside = f" (also: {', '.join(others)})" if others else ""
        size = f"{self._camera.width}x{self._camera.height}"
        return f"<{self._recording.kind} {self.name}: {len(self)} frames of camera {self._camera.name}{beside}, {size}>"

    def _repr_html_(self) -> str:
        return f"{picture_html(self[0].rgb)}<br><code>{escape(repr(self))}</code>"


class RecordingTable(Mapping[str, RecordedFrames]):
    """The scans or the demonstrations of a dataset, by name."""

    def __init__(self, where: Path, what: str, names: Sequence[str], opened: Callable[[str], RecordedFrames]) -> None:
        self._where, self._what, self._names, self._opened = where, what, tuple(names), opened

    def __getitem__(self, name: str) -> RecordedFrames:
        if name not in self._names:
            known = f"one of {', '.join(self._names)}" if self._names else f"no {self._what}s, as there are none"
            raise KeyError(f"{self._where}: {self._what}: expected {known}, got {name}")
        return self._opened(name)

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)

    def _ipython_key_completions_(self) -> list[str]:
        return list(self._names)

    def __repr__(self) -> str:
        return f"<{len(self)} {self._what}s: {', '.join(self._names) or 'none'}>"


def picture_html(rgb: np.ndarray) -> str:
    """A small picture (h, w, 3) uint8 as an `<img>` that needs no file."""
    import cv2

    from bask_data.drawing.pictures import jpeg_uri

    height, width = rgb.shape[:2]
    share = min(THUMBNAIL / max(height, width), 1.0)
    size = (max(round(width * share), 1), max(round(height * share), 1))
    return f'<img alt="" src="{jpeg_uri(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA))}">'
