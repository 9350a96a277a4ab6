"""Frames of video files, by number: decoded one after another, exact, within bounds.

FFmpeg decodes; the file's packets say beforehand how many frames there are and when each is shown. The rotation that
phones note for players is ignored, as intrinsics refer to the picture that is stored.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8, UInt16
from numpy import ndarray

from bask_data.errors import BadData, imported
from bask_data.formats.images import MAX_PIXELS

CONTAINERS = "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm"
"""FFmpeg's names of the containers that are read. Playlists and lists of files are not among them: whatever their own
name, they lead to other files."""


@dataclass(frozen=True)
class _Index:
    """The frames of a stream in the order in which they are shown.

    Args:
        pts: presentation time of each frame, units of `unit`.
        keys: whether decoding can begin at it.
    """

    pts: tuple[int, ...]
    keys: tuple[bool, ...]
    unit: Fraction


class VideoFrames:
    """The frames of a video file's first video stream.

    Any frame can be asked for; ascending order is fastest: the file is then read once. Frames before a keyframe are
    skipped, and only a frame before the last one needs a jump back. One decoded frame is held.

        video = VideoFrames(path)
        rgb = video.color(7)
    """

    def __init__(self, path: Path, *, user: str, whole: bool = False) -> None:
        """Open the file and read its header; nothing is decoded.

        Args:
            user: the command or format that needs the video, for messages.
            whole: whether to count frames that the file has and tells players not to show (an edit list), too.

        Raises:
            BadData: not a video in one of `CONTAINERS`, no video stream, or more than `MAX_PIXELS` by its header.
            MissingDependency: PyAV is not installed.
        """
        self.path = path
        self._options = {"format_whitelist": CONTAINERS, **({"ignore_editlist": "1"} if whole else {})}
        self._av = imported("av", "PyAV", user=user, extra="formats")
        self._frame: tuple[int, Any] | None = None
        self._container: Any = None
        self._decoded: Iterator[Any] = iter(())
        self._next = 0
        self._restart()
        context = self._stream.codec_context
        self.size = (int(context.height), int(context.width))
        """(height, width) of the frames as stored, pixels."""
        if not 0 < self.size[0] * self.size[1] <= MAX_PIXELS:
            got = f"{self.size[1]} x {self.size[0]} in the header"
            raise BadData(path, "size", expected=f"1 to {MAX_PIXELS} pixels", got=got)

    @property
    def n_frames(self) -> int:
        """Number of frames in the file."""
        return len(self._index.pts)

    @cached_property
    def time(self) -> Float[ndarray, " n"]:
        """Seconds at which each frame is shown."""
        return np.array(self._index.pts, np.float64) * float(self._index.unit)

    def color(self, i: int) -> UInt8[ndarray, "h w 3"]:
        """A frame as RGB, by the colour standard and range that the file states (BT.601 if it states none).

        Raises:
            BadData: there is no such frame, or it does not decode.
        """
        frame = self._at(i)
        # Without a range stated, the pixel format decides: "yuvj420p" is a full range by itself.
        stated, full = (int(frame.color_range), "JPEG") if frame.color_range else (None, None)
        frame = frame.reformat(format="rgb24", src_color_range=stated, dst_color_range=full)
        return frame.to_ndarray()

    def grey(self, i: int) -> UInt16[ndarray, "h w"]:
        """The values of a frame's first plane as stored: brightness of 8 to 16 bits, not scaled.

        Raises:
            BadData: as `color`; or the first plane is no brightness.
        """
        frame = self._at(i)
        component = frame.format.components[0]
        if frame.format.is_rgb or frame.format.has_palette or component.plane or frame.format.is_big_endian:
            raise BadData(
                self.path,
                "pixels",
                expected="brightness in a plane of its own, grey or YUV",
                got=frame.format.name,
                fix="write the video as gray12le, or name the stream that holds it.",
            )
        plane = frame.planes[0]
        values = np.frombuffer(plane, np.uint8 if component.bits <= 8 else "<u2")
        rows = values.reshape(plane.height, plane.line_size // values.itemsize)
        return rows[: self.size[0], : self.size[1]].astype(np.uint16)

    @cached_property
    def bits(self) -> int:
        """Bits per value of the first plane."""
        return int(self._stream.codec_context.format.components[0].bits)

    @property
    def _stream(self) -> Any:
        return self._container.streams.video[0]

    @cached_property
    def _index(self) -> _Index:
        """From the packets of the file, which is read once for it, before anything is decoded."""
        packets = []
        try:
            for packet in self._container.demux(self._stream):
                if packet.size and not packet.is_discard:
                    packets.append((packet.pts if packet.pts is not None else packet.dts, packet.is_keyframe))
        except self._av.FFmpegError as error:
            raise self._unreadable("a readable file", error) from error
        if not packets or any(pts is None for pts, _ in packets):
            raise BadData(
                self.path,
                "frames",
                expected="frames with their times",
                got="a frame without" if packets else "none",
                fix=f"write it anew: ffmpeg -i {self.path.name} new.mp4",
            )
        packets.sort()
        pts, keys = zip(*packets, strict=True)
        if any(a == b for a, b in pairwise(pts)):
            raise BadData(self.path, "frames", expected="times that differ", got="two frames at one time")
        index = _Index(pts, keys, Fraction(self._stream.time_base))
        # The file is at its end: as at the last frame, so that the first one is sought.
        self._next = len(pts)
        return index

    def _opened(self) -> Any:
        try:
            # An absolute path cannot be taken for a protocol (`concat:`).
            container = self._av.open(str(self.path.absolute()), options=self._options)
        except (self._av.FFmpegError, OSError) as error:
            raise self._unreadable("a video in mp4, mov, mkv or webm", error) from error
        if not container.streams.video:
            container.close()
            raise BadData(self.path, "video", expected="a video stream", got="none in the file")
        return container

    def _at(self, i: int) -> Any:
        """The decoded frame i."""
        if not 0 <= i < self.n_frames:
            raise BadData(self.path, f"frame {i}", expected=f"a frame below {self.n_frames}", got="none")
        if self._frame is None or self._frame[0] != i:
            self._frame = None  # Two frames would be held while the next one is decoded.
            self._frame = (i, self._decode(i))
        return self._frame[1]

    def _decode(self, i: int) -> Any:
        wanted = self._index.pts[i]
        key = next((k for k in range(i, -1, -1) if self._index.keys[k]), 0)
        try:
            frame = self._sought(i, key) if i < self._next or key > self._next else self._found(i)
            if frame is None or frame.pts != wanted:
                # Containers seek by the order of decoding, which may lead beyond the frame.
                self._restart()
                frame = self._found(i)
        except self._av.FFmpegError as error:
            self._restart()
            raise self._unreadable(f"frame {i} to decode", error) from error
        if frame is None or frame.pts != wanted or (frame.height, frame.width) != self.size:
            self._restart()
            got = "none at its time" if frame is None or frame.pts != wanted else f"{frame.width} x {frame.height}"
            raise self._unreadable(f"frame {i} of {self.size[1]} x {self.size[0]}", got)
        self._next = i + 1
        return frame

    def _found(self, i: int) -> Any:
        """The first frame from here on that is not shown before frame i; None at the end."""
        wanted = self._index.pts[i]
        return next((frame for frame in self._decoded if frame.pts is not None and frame.pts >= wanted), None)

    def _sought(self, i: int, key: int) -> Any:
        self._container.seek(self._index.pts[key], stream=self._stream)
        self._decoded = self._container.decode(video=0)
        return self._found(i)

    def _restart(self) -> None:
        """Begin anew at the first frame: decoders cannot go on after an error."""
        if self._container is not None:
            self._container.close()
        self._container = self._opened()
        self._stream.thread_type = "AUTO"
        # The header states one size, and each frame may state another.
        self._stream.codec_context.options = {"max_pixels": str(MAX_PIXELS)}
        self._decoded = self._container.decode(video=0)
        self._next = 0

    def _unreadable(self, expected: str, got: object) -> BadData:
        text = str(got).replace(str(self.path.absolute()), self.path.name)[:200]
        return BadData(self.path, "video", expected=expected, got=text, fix="copy it again from its source.")
