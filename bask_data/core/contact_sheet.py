"""A picture with rows of small images under captions, to compare them at a glance."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import UInt8
from numpy import ndarray

CAPTION = 18
"""Height of a caption, pixels."""
PAPER, INK = 255, 30
"""Grey levels of the paper and of the captions."""


def contact_sheet(
    rows: Sequence[tuple[str, Sequence[tuple[str, UInt8[ndarray, "s s 3"]]]]], n_columns: int = 8
) -> UInt8[ndarray, "h w 3"]:
    """Images of one size in rows, each row with a title, each image with a caption below.

    Args:
        rows: title, and (caption, image) of each; a row of more than `n_columns` is continued below.

    Raises:
        ValueError: there is no image.
    """
    size = next((image.shape[0] for _, images in rows for _, image in images), 0)
    if not size:
        raise ValueError("expected images, got none")
    bands = []
    for title, images in rows:
        bands.append(_text(title, size * n_columns))
        for first in range(0, len(images), n_columns):
            tiles = [np.vstack([image, _text(caption, size)]) for caption, image in images[first : first + n_columns]]
            blank = np.full((size + CAPTION, size * (n_columns - len(tiles)), 3), PAPER, np.uint8)
            bands.append(np.hstack([*tiles, blank]))
    return np.vstack(bands)


def _text(text: str, width: int) -> UInt8[ndarray, "c w 3"]:
    import cv2

    band = np.full((CAPTION, width, 3), PAPER, np.uint8)
    plain = text.encode("ascii", "replace").decode()  # OpenCV's fonts have no other characters.
    scale = 0.38
    while scale > 0.25 and cv2.getTextSize(plain, cv2.FONT_HERSHEY_SIMPLEX, scale, 1)[0][0] > width - 6:
        scale -= 0.02
    cv2.putText(band, plain, (3, CAPTION - 5), cv2.FONT_HERSHEY_SIMPLEX, scale, (INK,) * 3, 1, cv2.LINE_AA)
    return band
