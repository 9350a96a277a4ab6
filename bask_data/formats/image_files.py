"""Image files of a camera, a colour and a depth file for each frame."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import UInt8, UInt16
from numpy import ndarray

from bask_data.core.rotated_bits import rotated_back
from bask_data.errors import BadData
from bask_data.formats.depth_files import read_any_depth
from bask_data.formats.files import first_readable
from bask_data.formats.images import image_header, read_color, read_labels
from bask_data.formats.recording import Depth


@dataclass(frozen=True)
class ImageFiles:
    """The image files of one camera, by frame; None where a frame has none.

    Args:
        label: label images, or empty.
        invalid_depth: raw values besides 0 that mean no measurement.
        rotated_depth: whether raw depth is rotated left by three bits, as in APC recordings.
    """

    color: tuple[Path | None, ...]
    depth: tuple[Path | None, ...]
    label: tuple[Path | None, ...] = ()
    invalid_depth: tuple[int, ...] = ()
    rotated_depth: bool = False

    @property
    def files(self) -> tuple[Path, ...]:
        """All files that there are."""
        return tuple(path for path in (*self.color, *self.depth, *self.label) if path is not None)

    @cached_property
    def size(self) -> tuple[int, int]:
        """(height, width) of the first colour image that can be read, pixels."""
        header = first_readable(image_header, (path for path in self.color if path is not None))
        return header.height, header.width

    @cached_property
    def is_float(self) -> bool:
        """Whether depth is in floating point, by the first file that can be read; the others are reported later."""
        for path in self.depth:
            try:
                if path is not None:
                    return read_any_depth(path).dtype != np.uint16
            except BadData:
                continue
        return False

    def read_color(self, i: int) -> UInt8[ndarray, "h w 3"]:
        path = _there(self.color[i])
        image = read_color(path)
        if image.shape[:2] != self.size:
            raise BadData(
                path,
                "size",
                expected=f"{self.size[1]} x {self.size[0]} as in {_first(self.color).name}",
                got=f"{image.shape[1]} x {image.shape[0]}",
                fix="read the frames of one size: --frames FIRST:END, or --skip-bad.",
            )
        return image

    def read_depth(self, i: int) -> Depth:
        path = _there(self.depth[i])
        raw = read_any_depth(path)
        if self.invalid_depth:
            raw = np.where(np.isin(raw, self.invalid_depth), raw.dtype.type(0), raw)
        if self.rotated_depth:
            return _rotated_back(path, raw)
        if (raw.dtype != np.uint16) != self.is_float:
            raise BadData(
                path,
                "depth",
                expected=f"{'floating point' if self.is_float else 'whole numbers'} as in {_first(self.depth).name}",
                got=str(raw.dtype),
                fix="take depth files of one kind.",
            )
        return raw

    def read_labels(self, i: int) -> UInt8[ndarray, "h w"]:
        return read_labels(_there(self.label[i]))


def _rotated_back(path: Path, raw: Depth) -> UInt16[ndarray, "h w"]:
    if raw.dtype != np.uint16:
        raise BadData(path, "depth", expected="one channel of 16 bits", got=str(raw.dtype))
    return rotated_back(raw)


def _there(path: Path | None) -> Path:
    assert path is not None  # Frames without a file are in the faults of the recording, and are not read.
    return path


def _first(paths: tuple[Path | None, ...]) -> Path:
    return next(path for path in paths if path is not None)
