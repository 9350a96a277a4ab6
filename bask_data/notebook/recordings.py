"""Recordings as sequences of frames."""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, SupportsIndex, overload

from bask_data.errors import BaskError, UsageError
from bask_data.kinds import Camera, Demonstration, Robot, Scan
from bask_data.notebook.html import picture_html
from bask_data.spelling import choices, suggestion

if TYPE_CHECKING:
    import numpy as np

STRIP_FRAMES = 3
"""Frames that a recording shows in a notebook: its first, its last and what lies between."""
MOST_SHOWN = 6
"""Recordings that a table of them shows in a notebook; the others are named."""

Masks = Callable[[str, int], "np.ndarray"]
"""Gives the mask of a camera's frame."""


class UnknownName(UsageError, KeyError):
    """There is no recording of that name: a `KeyError`, as a mapping raises, with the names there are."""

    def __str__(self) -> str:
        # KeyError's own gives the message in quotes, with its line ends escaped.
        return Exception.__str__(self)


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
        K: np.ndarray = self._camera.Ks[self.index].copy()
        return K

    @property
    def world_from_camera(self) -> np.ndarray:
        """(4, 4) float64, metres; camera x right, y down, z forward."""
        transform: np.ndarray = self._camera.world_from_cameras[self.index].copy()
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

    def __init__(
        self, recording: Scan | Demonstration, masks: Masks, camera: str = "", chosen: range | None = None
    ) -> None:
        """The frames of a camera, by default of the first.

        Args:
            chosen: numbers of the frames; by default all.
        """
        self._recording, self._masks = recording, masks
        self.name = recording.path.name
        """Name of the scene or demonstration."""
        self._camera = recording.camera(camera or recording.camera_names[0])
        self._chosen = range(self._camera.n_frames) if chosen is None else chosen

    @property
    def cameras(self) -> list[str]:
        """Names of all cameras."""
        return self._recording.camera_names

    @property
    def robot(self) -> Robot | None:
        """What the robot did, in a demonstration that recorded it."""
        return self._recording.robot if isinstance(self._recording, Demonstration) else None

    @property
    def origin(self) -> tuple[float, float, float]:
        """Origin of the world frame in the source's, metres: add it to positions to get the source's."""
        origin: tuple[float, float, float] = self._recording.metadata.origin
        return origin

    @property
    def Ks(self) -> np.ndarray:
        """Pinhole matrix of each frame (t, 3, 3) float64, pixels; (0, 0) is the centre of the top-left pixel."""
        matrices: np.ndarray = self._camera.Ks[list(self._chosen)]
        return matrices

    @property
    def K(self) -> np.ndarray:
        """Pinhole matrix (3, 3) float64 of all frames, pixels.

        Raises:
            UsageError: it changes from frame to frame.
        """
        Ks = self.Ks if len(self) else self._camera.Ks
        if (Ks != Ks[:1]).any():
            fix = "take .Ks, or .K of a frame."
            expected, got = "the same pinhole matrix in all frames", "one that changes"
            raise UsageError(self._recording.path, f"{self._camera.name}: K", expected=expected, got=got, fix=fix)
        K: np.ndarray = Ks[0].copy()
        return K

    @property
    def world_from_cameras(self) -> np.ndarray:
        """(t, 4, 4) float64, metres; camera x right, y down, z forward."""
        transforms: np.ndarray = self._camera.world_from_cameras[list(self._chosen)]
        return transforms

    @property
    def time(self) -> np.ndarray:
        """(t,) float64, seconds."""
        times: np.ndarray = self._camera.time[list(self._chosen)]
        return times

    def camera(self, name: str) -> RecordedFrames:
        """All frames of a camera.

        Raises:
            UsageError: there is no such camera.
        """
        if name not in self.cameras:
            expected, fix = f"one of {', '.join(self.cameras)}", suggestion(str(name), self.cameras)
            raise UsageError(self._recording.path, "camera", expected=expected, got=name, fix=fix)
        return RecordedFrames(self._recording, self._masks, name)

    def __len__(self) -> int:
        return len(self._chosen)

    @overload
    def __getitem__(self, i: SupportsIndex) -> RecordedFrame: ...
    @overload
    def __getitem__(self, i: slice) -> RecordedFrames: ...
    def __getitem__(self, i: SupportsIndex | slice) -> RecordedFrame | RecordedFrames:
        if isinstance(i, slice):
            return RecordedFrames(self._recording, self._masks, self._camera.name, self._chosen[i])
        try:
            i_frame = operator.index(i)
        except TypeError:
            fix = f'.camera("{i}") gives the frames of a camera.' if str(i) in self.cameras else ""
            got = f"{type(i).__name__} {i!r}"
            message = str(UsageError(self.name, "frame", expected="a whole number or a slice", got=got, fix=fix))
            raise TypeError(message) from None
        if not -len(self) <= i_frame < len(self):
            raise IndexError(f"{self.name}: frame: expected one of 0 to {len(self) - 1}, got {i_frame}")
        return RecordedFrame(self._camera, self._chosen[i_frame], self._masks)

    def __repr__(self) -> str:
        others = [name for name in self.cameras if name != self._camera.name]
        beside = f" (also: {', '.join(others)})" if others else ""
        size = f"{self._camera.width}x{self._camera.height}"
        n_all = self._camera.n_frames
        n = f"{len(self)} frames" if len(self) == n_all else f"{len(self)} of {n_all} frames"
        return f"<{self._recording.kind} {self.name}: {n} of camera {self._camera.name}{beside}, {size}>"

    def _repr_html_(self) -> str:
        steps = max(min(len(self), STRIP_FRAMES) - 1, 1)
        shown = sorted({(len(self) - 1) * k // steps for k in range(steps + 1)}) if len(self) else []
        return f"{''.join(picture_html(self[i].rgb) for i in shown)}<br><code>{escape(repr(self))}</code>"


class RecordingTable(Mapping[str, RecordedFrames]):
    """The scans or the demonstrations of a dataset, by name."""

    def __init__(self, where: Path, what: str, names: Sequence[str], opened: Callable[[str], RecordedFrames]) -> None:
        self._where, self._what, self._names, self._opened = where, what, tuple(names), opened

    def __getitem__(self, name: str) -> RecordedFrames:
        if name not in self._names:
            known = f"one of {choices(self._names)}" if self._names else f"no {self._what}s, as there are none"
            fix = suggestion(str(name), self._names)
            raise UnknownName(self._where, self._what, expected=known, got=repr(name), fix=fix)
        return self._opened(name)

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)

    def _ipython_key_completions_(self) -> list[str]:
        return list(self._names)

    def __repr__(self) -> str:
        names = ", ".join(self._names) or "none"
        return f"<{len(self)} {self._what}{'' if len(self) == 1 else 's'}: {names}>"

    def _repr_html_(self) -> str:
        shown = "".join(f"<p>{self._shown(name)}</p>" for name in self._names[:MOST_SHOWN])
        others = ", ".join(self._names[MOST_SHOWN:])
        return f"<p><b>{escape(repr(self))}</b></p>{shown}" + (f"<p>and {escape(others)}</p>" if others else "")

    def _shown(self, name: str) -> str:
        try:
            return self[name]._repr_html_()
        except BaskError as error:  # One that is damaged, or not there, leaves the others to be seen.
            return escape(str(error))
