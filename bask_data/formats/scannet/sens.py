"""ScanNet's sensor files: calibration, poses, and compressed colour and depth images one after another.

Source: github.com/ScanNet/ScanNet, SensReader/python/SensorData.py.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from io import BufferedReader
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8, UInt16
from numpy import ndarray

from bask_data.errors import BadData
from bask_data.formats.files import MAX_IMAGE_BYTES
from bask_data.formats.images import MAX_PIXELS, decode_color
from bask_data.formats.intrinsics import intrinsics_matrix
from bask_data.formats.poses import rigid

VERSION = 4
"""The one version of the format that ScanNet has."""

LONGEST_NAME = 4096
"""Largest length of the sensor's name, bytes. Chosen; keeps damaged files from filling memory."""

FRAME_HEADER = struct.Struct("<16f4Q")
"""world_from_body, times of colour and depth in microseconds, and sizes of their images in bytes."""

COLOR_RAW, COLOR_PNG, COLOR_JPEG = 0, 1, 2
DEPTH_RAW, DEPTH_ZLIB = 0, 1
"""Ways of compression. Depth may also be 2, `occi`, a codec that only ScanNet's C++ code has."""


@dataclass(frozen=True)
class SensFile:
    """A sensor file, whose images are read on demand.

    Args:
        places: of each frame, where its colour begins, and the bytes of its colour and its depth.
        time: seconds, by the stamps of colour; None if they do not increase.
        color_compression, depth_compression: numbers of the ways of compression.
    """

    path: Path
    color_K: Float[ndarray, "3 3"]
    depth_K: Float[ndarray, "3 3"]
    color_from_body: Float[ndarray, "4 4"]
    depth_from_body: Float[ndarray, "4 4"]
    color_size: tuple[int, int]
    depth_size: tuple[int, int]
    depth_scale: float
    world_from_body: Float[ndarray, "t 4 4"]
    time: Float[ndarray, " t"] | None
    places: tuple[tuple[int, int, int], ...]
    color_compression: int
    depth_compression: int

    @property
    def n_frames(self) -> int:
        """Number of frames."""
        return len(self.places)

    @classmethod
    def opened(cls, path: Path) -> SensFile:
        """The file at `path`, whose frames are found but not decoded; `BadData` if it is damaged."""
        with path.open("rb") as file:
            (version,) = _unpacked(file, path, struct.Struct("<I"))
            if version != VERSION:
                raise _damaged(path, "version", str(VERSION), str(version))
            (length,) = _unpacked(file, path, struct.Struct("<Q"))
            if length > LONGEST_NAME:
                raise _damaged(path, "sensor's name", f"at most {LONGEST_NAME} bytes", str(length))
            file.seek(length, 1)
            matrices = np.array(_unpacked(file, path, struct.Struct("<64f")), np.float64).reshape(4, 4, 4)
            color_code, depth_code, w, h, depth_w, depth_h, shift, n_frames = _unpacked(
                file, path, struct.Struct("<2i4IfQ")
            )
            _check_codes(path, color_code, depth_code)
            for width, height in ((w, h), (depth_w, depth_h)):
                if not 0 < width * height <= MAX_PIXELS:
                    raise _damaged(path, "size of images", f"1 to {MAX_PIXELS} pixels", f"{width} x {height}")
            if not shift > 0:
                raise _damaged(path, "depthShift", "units per metre, more than 0", f"{shift:g}")
            poses, stamps, places = _frames(file, path, n_frames)
        increase = np.isfinite(stamps).all() and (np.diff(stamps) > 0).all() and len(stamps) > 1
        return cls(
            path=path,
            color_K=intrinsics_matrix(path, matrices[0].ravel().tolist(), ""),
            depth_K=intrinsics_matrix(path, matrices[2].ravel().tolist(), ""),
            color_from_body=rigid(f"{path}: extrinsics of colour", matrices[1]),
            depth_from_body=rigid(f"{path}: extrinsics of depth", matrices[3]),
            color_size=(h, w),
            depth_size=(depth_h, depth_w),
            depth_scale=1 / round(shift, 6),
            world_from_body=poses,
            time=stamps / 1e6 if increase else None,
            places=places,
            color_compression=color_code,
            depth_compression=depth_code,
        )

    def color(self, i: int) -> UInt8[ndarray, "h w 3"]:
        """RGB of a frame."""
        start, n_color, _ = self.places[i]
        data = self._bytes(start, n_color)
        where = f"{self.path}: colour of frame {i}"
        if self.color_compression != COLOR_RAW:
            return decode_color(where, data)
        shape = (*self.color_size, 3)
        if len(data) != np.prod(shape):
            raise BadData(where, "size", expected=f"{np.prod(shape)} bytes", got=str(len(data)))
        return np.frombuffer(data, np.uint8).reshape(shape)

    def depth(self, i: int) -> UInt16[ndarray, "h w"]:
        """Raw depth of a frame."""
        start, n_color, n_depth = self.places[i]
        data = self._bytes(start + n_color, n_depth)
        expected = 2 * self.depth_size[0] * self.depth_size[1]
        if self.depth_compression == DEPTH_ZLIB:
            decoder = zlib.decompressobj()
            try:
                # Bounded, as a few bytes may stand for gigabytes.
                data = decoder.decompress(data, expected + 1)
            except zlib.error:
                data = b""
        if len(data) != expected:
            where = f"{self.path}: depth of frame {i}"
            raise BadData(where, "size", expected=f"{expected} bytes", got=f"{len(data)}, or a damaged stream")
        return np.frombuffer(data, "<u2").astype(np.uint16).reshape(self.depth_size)

    def _bytes(self, start: int, n_bytes: int) -> bytes:
        with self.path.open("rb") as file:
            file.seek(start)
            return file.read(n_bytes)


def _frames(
    file: BufferedReader, path: Path, n_frames: int
) -> tuple[Float[ndarray, "t 4 4"], Float[ndarray, " t"], tuple[tuple[int, int, int], ...]]:
    """Poses, stamps and places of all frames: their headers are read, and their images are skipped."""
    size = path.stat().st_size
    if not 0 < n_frames <= size // FRAME_HEADER.size:
        raise _damaged(path, "number of frames", f"1 to {size // FRAME_HEADER.size} in {size} bytes", str(n_frames))
    poses, stamps, places = np.zeros((n_frames, 4, 4)), np.zeros(n_frames), []
    for i in range(n_frames):
        *pose, color_stamp, _, n_color, n_depth = _unpacked(file, path, FRAME_HEADER)
        start = file.tell()
        if max(n_color, n_depth) > MAX_IMAGE_BYTES or start + n_color + n_depth > size:
            got = f"{n_color} and {n_depth} bytes of images, of {size - start} that are left"
            raise _damaged(path, f"frame {i}", "images inside the file", got)
        poses[i], stamps[i] = np.array(pose).reshape(4, 4), color_stamp
        places.append((start, n_color, n_depth))
        file.seek(n_color + n_depth, 1)
    return poses, stamps, tuple(places)


def _check_codes(path: Path, color: int, depth: int) -> None:
    if color not in (COLOR_RAW, COLOR_PNG, COLOR_JPEG) or depth not in (DEPTH_RAW, DEPTH_ZLIB):
        raise BadData(
            path,
            "compression",
            expected="colour raw, PNG or JPEG (0, 1, 2), and depth raw or zlib (0, 1)",
            got=f"{color} and {depth}",
            fix="export it with ScanNet's SensReader in C++, and read the folder.",
        )


def _unpacked(file: BufferedReader, path: Path, layout: struct.Struct) -> tuple:
    data = file.read(layout.size)
    if len(data) < layout.size:
        raise _damaged(path, "size", "the frames that the header states", "a truncated file")
    return layout.unpack(data)


def _damaged(path: Path, field: str, expected: str, got: str) -> BadData:
    return BadData(path, field, expected=expected, got=got, fix="download it again; it may be no .sens file.")
