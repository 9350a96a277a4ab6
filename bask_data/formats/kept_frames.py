"""Frames that checks have decoded, kept for the reading that follows: decoding is most of what ingest costs."""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, TypeVar

import numpy as np

Image = TypeVar("Image", bound=np.ndarray)

MOST_BYTES = 32 * 2**20
"""Kept of the colour, and of the depth, of a camera, bytes: all that checks look at in images of 640x480. Keeps memory
flat in the number and the size of frames."""


class KeptFrames(Generic[Image]):
    """Frames by index, each decoded once: as many as fit are kept until they are read again after `hand_out`."""

    def __init__(self, decode: Callable[[int], Image]) -> None:
        self._decode = decode
        self._kept: dict[int, Image] = {}
        self._n_bytes = 0
        self._is_checking = True

    def __call__(self, i: int) -> Image:
        """The image of a frame."""
        if not self._is_checking:
            return self._kept.pop(i) if i in self._kept else self._decode(i)
        if i not in self._kept:
            image = self._decode(i)
            if self._n_bytes + image.nbytes > MOST_BYTES:
                return image
            self._kept[i] = image
            self._n_bytes += image.nbytes
        return self._kept[i]

    def hand_out(self) -> None:
        """End the checks: frames are read once more, and no longer kept."""
        self._is_checking = False
