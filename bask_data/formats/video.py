"""Video files for browsers: H.264 in mp4."""

from __future__ import annotations

import os
import uuid
from fractions import Fraction
from pathlib import Path
from types import ModuleType, TracebackType
from typing import Any

import numpy as np
from jaxtyping import UInt8
from numpy import ndarray

from bask_data.errors import BaskError, imported

BT_709, BT_601 = 1, 6
"""FFmpeg's codes of the colour standards of high-definition and older video."""


def import_av() -> ModuleType:
    """The module `av`; `MissingDependency` if it is not installed."""
    return imported("av", "PyAV", user="video", extra="export")


class VideoWriter:
    """Writer of an mp4 file, frame by frame; the file appears when the `with` block ends without an error.

    The same frames give the same bytes with the same version of PyAV.

        with VideoWriter(path, fps=30, size=(height, width)) as video:
            for image in images:
                video.append(image)
    """

    def __init__(
        self,
        path: Path | str,
        fps: int | float | Fraction,
        size: tuple[int, int],
        *,
        keyframe_every: int = 30,
        quality: int = 18,
    ) -> None:
        """Prepare writing; the file is opened by `with`.

        Args:
            fps: frames per second.
            size: (height, width) of every frame, pixels.
            keyframe_every: distance of keyframes, frames; a small one makes seeking fast.
            quality: x264's constant rate factor: 0 is lossless except for colour resolution, 18 visually lossless, 51
                the worst.

        Raises:
            ValueError: `fps` or `size` is not positive.
            MissingDependency: PyAV is not installed.
        """
        if not fps > 0 or not np.isfinite(float(fps)) or min(size) < 1:
            raise ValueError(f"{path}: a video of {fps} frames per second, {size[0]} x {size[1]} pixels")
        self.path = Path(path)
        self.fps = Fraction(fps).limit_denominator(100_000)
        self.size = size
        self.n_frames = 0
        self._keyframe_every, self._quality = keyframe_every, quality
        self._av = import_av()
        self._unfinished = self.path.with_name(f".{self.path.name}.{os.getpid()}.{uuid.uuid4().hex[:8]}")
        self._container: Any = None
        self._stream: Any = None

    @property
    def coded_size(self) -> tuple[int, int]:
        """(height, width) of the file's frames, pixels: even, as colours are stored per two by two pixels."""
        height, width = self.size
        return height + height % 2, width + width % 2

    @property
    def n_bytes(self) -> int:
        """Bytes written so far, without frames that are still being encoded."""
        return self._unfinished.stat().st_size if self._unfinished.exists() else 0

    def __enter__(self) -> VideoWriter:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        try:
            # The index comes first, so that browsers play before the download ends. Dates and library versions are left
            # out, so that the bytes depend on the frames only.
            options = {"movflags": "+faststart", "fflags": "+bitexact"}
            self._container = self._av.open(str(self._unfinished), "w", format="mp4", options=options)
            self._stream = self._new_stream()
        except BaseException:
            self._close(keep=False)
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        whole = False
        try:
            if kind is None:
                if self.n_frames == 0:
                    raise ValueError(f"{self.path}: a video without frames")
                self._flush()
                whole = True
        finally:
            self._close(whole)

    def append(self, rgb: UInt8[ndarray, "h w 3"]) -> None:
        """Append a frame; odd sizes are padded by repeating the last row or column.

        Raises:
            ValueError: the frame's size differs from the video's.
            BaskError: the file cannot be written.
        """
        if rgb.shape[:2] != self.size:
            raise ValueError(f"{self.path}: a frame of {rgb.shape[:2]} pixels in a video of {self.size}")
        height, width = self.coded_size
        padded = np.pad(rgb, ((0, height - self.size[0]), (0, width - self.size[1]), (0, 0)), mode="edge")
        frame = self._av.VideoFrame.from_ndarray(np.ascontiguousarray(padded), format="rgb24")
        frame = frame.reformat(format="yuv420p", dst_colorspace="ITU601", dst_color_range="MPEG")
        frame.pts, frame.time_base = self.n_frames, 1 / self.fps
        try:
            self._container.mux(self._stream.encode(frame))
        except OSError as error:
            raise self._unwritable(error) from error
        self.n_frames += 1

    def _new_stream(self) -> Any:
        stream = self._container.add_stream("libx264", rate=self.fps)
        stream.height, stream.width = self.coded_size
        stream.pix_fmt = "yuv420p"
        stream.time_base = 1 / self.fps
        context = stream.codec_context
        # Players read the colour standard from the file; readers for networks (torchvision, PyAV) assume BT.601. So
        # BT.601 is written and declared.
        context.color_primaries = context.color_trc = BT_709
        context.colorspace = BT_601
        context.color_range = 1  # 16 to 235, as in nearly every video
        context.gop_size = self._keyframe_every
        # x264's output depends on the number of threads.
        context.thread_count = 1
        # Scene cuts would add keyframes, and frames predicted from later ones make seeking inexact.
        stream.options = {
            "crf": str(self._quality),
            "preset": "medium",
            "x264-params": f"threads=1:scenecut=0:keyint={self._keyframe_every}:bframes=0",
        }
        return stream

    def _flush(self) -> None:
        try:
            self._container.mux(self._stream.encode(None))
        except OSError as error:
            raise self._unwritable(error) from error

    def _close(self, keep: bool) -> None:
        try:
            if self._container is not None:
                self._container.close()
            if keep:
                os.replace(self._unfinished, self.path)
        except OSError as error:
            raise self._unwritable(error) from error
        finally:
            self._unfinished.unlink(missing_ok=True)

    def _unwritable(self, error: OSError) -> BaskError:
        got, fix = str(error)[:200], "free disk space, or check the permissions of the folder."
        return BaskError(self.path, "", expected="a writable file", got=got, fix=fix)
