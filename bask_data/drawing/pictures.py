"""Pictures of keypoints and heat maps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from bask_data.core.geometry import scale_pixels
from bask_data.drawing.colours import INVALID, WHITE, Colour
from bask_data.drawing.images import resize
from bask_data.drawing.strokes import SUBPIXEL_BITS, cross, dot, ellipse, fixed_point, number, polyline

RING_PX = 7.0
"""Radius of the ring around a best match, pixels."""
HEAT_GAMMA = 0.5
"""Exponent of heat maps: a tenth of the maximum is drawn at a third of the scale. Sensitivity not measured."""
GREY_SHARE = 0.8
"""Brightness of the image under a heat map."""


@dataclass(frozen=True)
class Mark:
    """A keypoint to draw, in pixels of the image as recorded.

    Args:
        seen: whether the filter considers it visible to the camera; drawn filled, otherwise hollow.
        trail: (n, 2) earlier pixels, oldest first; NaN breaks the line.
        covariance: (2, 2) square pixels; drawn as its one-sigma ellipse.
        truth: (2,) ground truth; a cross, joined to the mark by a line.
    """

    number: int
    pixel: np.ndarray
    colour: Colour
    seen: bool = True
    trail: np.ndarray | None = None
    covariance: np.ndarray | None = None
    truth: np.ndarray | None = None


def marks_picture(rgb: np.ndarray, marks: Sequence[Mark], width: int) -> np.ndarray:
    """The image with numbered keypoints in their colours."""
    picture = np.ascontiguousarray(resize(rgb, width))
    size, new_size = rgb.shape[:2], picture.shape[:2]
    factor = width / rgb.shape[1]
    for mark in marks:
        if mark.trail is not None and len(mark.trail) > 1:
            polyline(picture, scale_pixels(mark.trail.astype(np.float64), size, new_size), mark.colour)
    for mark in marks:
        point = scale_pixels(mark.pixel.astype(np.float64), size, new_size)
        truth = None if mark.truth is None else scale_pixels(mark.truth.astype(np.float64), size, new_size)
        if truth is not None and np.isfinite(truth).all() and np.isfinite(point).all():
            cv2.line(picture, fixed_point(point), fixed_point(truth), (255, 255, 255), 1, cv2.LINE_AA, SUBPIXEL_BITS)
        if truth is not None and np.isfinite(truth).all():
            cross(picture, truth, mark.colour)
        if not np.isfinite(point).all():
            continue
        if mark.covariance is not None and np.isfinite(mark.covariance).all():
            ellipse(picture, point, mark.covariance * factor**2, mark.colour)
        dot(picture, point, 5.0, mark.colour, filled=mark.seen)
    for mark in marks:
        point = scale_pixels(mark.pixel.astype(np.float64), size, new_size)
        if np.isfinite(point).all() and (np.abs(point) < 2 * width).all():
            number(picture, str(mark.number), point + np.array([8, -7]))
    return picture


def heat_picture(
    rgb: np.ndarray, heat: np.ndarray, marks: Sequence[Mark], width: int, *, truth_seen: bool = True
) -> np.ndarray:
    """A heat map (any resolution, scaled to its maximum, faint parts brightened) over the image in grey.

    Args:
        marks: best matches as rings, ground truth as crosses joined to them.
        truth_seen: whether the ground truth is visible in the image; if not, its crosses are grey.
    """
    picture = resize(rgb, width).astype(np.float32)
    size = (picture.shape[1], picture.shape[0])
    level = np.clip(cv2.resize((heat / max(float(heat.max()), 1e-12)).astype(np.float32), size), 0, 1)
    level = level**HEAT_GAMMA
    glow = cv2.applyColorMap((level * 255).astype(np.uint8), cv2.COLORMAP_INFERNO)
    glow = cv2.cvtColor(glow, cv2.COLOR_BGR2RGB).astype(np.float32)
    grey = picture.mean(axis=2, keepdims=True)
    weight = level[..., None]
    blended = (1 - weight) * (GREY_SHARE * grey) + weight * glow
    drawn = np.clip(blended, 0, 255).astype(np.uint8)
    for mark in marks:
        point = scale_pixels(mark.pixel.astype(np.float64), rgb.shape[:2], drawn.shape[:2])
        truth = mark.pixel * np.nan if mark.truth is None else mark.truth.astype(np.float64)
        truth = scale_pixels(truth, rgb.shape[:2], drawn.shape[:2])
        if np.isfinite([*point, *truth]).all() and truth_seen:
            # The line ends at the ring, whose inside stays visible.
            start = point + (truth - point) * min(1.0, RING_PX / max(float(np.linalg.norm(truth - point)), 1e-9))
            cv2.line(drawn, fixed_point(start), fixed_point(truth), WHITE, 1, cv2.LINE_AA, SUBPIXEL_BITS)
        if np.isfinite(truth).all():
            cross(drawn, truth, WHITE if truth_seen else INVALID, 5.0)
        if np.isfinite(point).all():
            dot(drawn, point, RING_PX, mark.colour, filled=False)
    return drawn


def crop_picture(rgb: np.ndarray, pixel: np.ndarray, half: int, width: int, colour: Colour) -> np.ndarray:
    """An enlarged square around a pixel, with a cross on it; `half` pixels from the centre to an edge."""
    padded = np.pad(rgb, ((half, half), (half, half), (0, 0)), mode="edge")
    u, v = np.rint(np.clip(pixel, 0, [rgb.shape[1] - 1, rgb.shape[0] - 1])).astype(int)
    crop = padded[v : v + 2 * half + 1, u : u + 2 * half + 1]
    picture = np.ascontiguousarray(resize(crop, width))
    middle = scale_pixels(pixel.astype(np.float64) - [u, v] + half, crop.shape[:2], picture.shape[:2])
    cross(picture, middle, colour)
    return picture
