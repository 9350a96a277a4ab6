"""Image files of a camera, a colour and a depth file for each frame."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import UInt8, UInt16
from numpy import ndarray

from bask_data.errors import BadData
from bask_data.formats.images import image_header, read_color, read_depth, read_labels


@dataclass(frozen=True)
class ImageFiles:
    """The image files of one camera, by frame.

    Args:
        label: label images, or empty.
        invalid_depth: raw values besides 0 that mean no measurement.
        rotated_depth: whether raw depth is rotated left by three bits, as in APC recordings.
    """

    color: tuple[Path, ...]
    depth: tuple[Path, ...]
    label: tuple[Path, ...] = ()
    invalid_depth: tuple[int, ...] = ()
    rotated_depth: bool = False

    @cached_property
    def size(self) -> tuple[int, int]:
        """(height, width) of the first colour image, pixels."""
        header = image_header(self.color[0])
        return header.height, header.width

    def read_color(self, i: int) -> UInt8[ndarray, "h w 3"]:
        image = read_color(self.color[i])
        if image.shape[:2] != self.size:
            raise BadData(
                self.color[i],
                "size",
                expected=f"{self.size[1]} x {self.size[0]} as in {self.color[0].name}",
                got=f"{image.shape[1]} x {image.shape[0]}",
                fix="read the frames of one size: --frames FIRST:END, or --skip-bad.",
            )
        return image

    def read_depth(self, i: int) -> UInt16[ndarray, "h w"]:
        raw = read_depth(self.depth[i])
        if self.invalid_depth:
            raw = np.where(np.isin(raw, self.invalid_depth), np.uint16(0), raw)
        return (raw >> np.uint16(3)) | (raw << np.uint16(13)) if self.rotated_depth else raw

    def read_labels(self, i: int) -> UInt8[ndarray, "h w"]:
        return read_labels(self.label[i])
