"""Pictures of masks: instances tinted, outlined and numbered."""

from __future__ import annotations

import cv2
import numpy as np

from bask_data.drawing.colours import Colour, palette
from bask_data.drawing.images import resize, resize_labels
from bask_data.drawing.strokes import FONT

HATCH, HATCH_PX = (24, 24, 24), 6
"""Colour of the hatching over parts of masks that no depth confirms, and its period in pixels."""


def mask_picture(
    rgb: np.ndarray, instance: np.ndarray, labels: np.ndarray | None, width: int, measured: np.ndarray | None = None
) -> np.ndarray:
    """The image with instances tinted, outlined and numbered; outlines of ground-truth labels, if given, in white.

    Args:
        measured: (h, w) bool; where False, no depth confirms the instance, and it is hatched.
    """
    picture = resize(rgb, width)
    instance = resize_labels(instance, picture.shape[:2])
    ids = [int(i) for i in np.unique(instance) if i]
    colours = palette(max(ids, default=0))
    table = np.zeros((256, 3), np.uint8)
    table[1 : len(colours) + 1] = np.array(colours, np.uint8).reshape(-1, 3)
    tint = table[instance]
    inside = instance > 0
    picture[inside] = (0.6 * picture[inside] + 0.4 * tint[inside]).astype(np.uint8)
    if measured is not None:
        unconfirmed = inside & (resize_labels(measured.astype(np.uint8), picture.shape[:2]) == 0)
        v, u = np.indices(unconfirmed.shape)
        picture[unconfirmed & ((u + v) % HATCH_PX < 2)] = HATCH
    picture = np.ascontiguousarray(picture)
    if labels is not None:
        labels = resize_labels(labels, picture.shape[:2])
        for label in np.unique(labels[labels > 0]):
            _outline(picture, labels == label, (255, 255, 255), 1)
    for i in ids:
        mask = instance == i
        _outline(picture, mask, colours[i - 1], 2)
        # The point deepest inside the mask, where a number hides least of its outline.
        inner = cv2.distanceTransform(np.pad(mask, 1).astype(np.uint8), cv2.DIST_L2, 3)[1:-1, 1:-1]
        v, u = np.unravel_index(inner.argmax(), inner.shape)
        _tag(picture, str(i), (float(u), float(v)), colours[i - 1])
    return picture


def _outline(picture: np.ndarray, mask: np.ndarray, colour: Colour, thickness: int) -> None:
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(picture, contours, -1, colour, thickness, cv2.LINE_AA)


def _tag(picture: np.ndarray, text: str, centre: tuple[float, float], colour: Colour) -> None:
    """A number on a box of this colour, in black or white, whichever contrasts more."""
    scale = 0.45
    (width, height), _ = cv2.getTextSize(text, FONT, scale, 1)
    u = int(np.clip(centre[0] - width / 2, 2, max(picture.shape[1] - width - 3, 2)))
    v = int(np.clip(centre[1] + height / 2, height + 3, max(picture.shape[0] - 3, height + 3)))
    cv2.rectangle(picture, (u - 2, v - height - 3), (u + width + 2, v + 3), colour, -1)
    bright = 0.299 * colour[0] + 0.587 * colour[1] + 0.114 * colour[2] > 130
    cv2.putText(picture, text, (u, v), FONT, scale, (0, 0, 0) if bright else (255, 255, 255), 1, cv2.LINE_AA)
