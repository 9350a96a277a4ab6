"""Dots, crosses, lines, ellipses and numbers at sub-pixel positions, outlined so that they show on any background."""

from __future__ import annotations

from itertools import pairwise

import cv2
import numpy as np

from bask_data.drawing.colours import Colour

SUBPIXEL_BITS = 4
"""Fraction bits of OpenCV's fixed-point coordinates: a sixteenth of a pixel, too small to see."""
FONT = cv2.FONT_HERSHEY_SIMPLEX


def fixed_point(point: np.ndarray) -> tuple[int, int]:
    """A point in OpenCV's fixed-point coordinates."""
    # Far outside the image, OpenCV's fixed-point coordinates overflow.
    u, v = np.rint(np.clip(point, -20000, 20000) * 2**SUBPIXEL_BITS).astype(int)
    return int(u), int(v)


def dot(picture: np.ndarray, point: np.ndarray, radius: float, colour: Colour, filled: bool = True) -> None:
    """Draw a dot, or a ring if it is not filled; `radius` in pixels."""
    size = round(radius * 2**SUBPIXEL_BITS)
    if filled:
        # A black and a white ring: one of them stands out from any background, even one of the dot's colour.
        for more, stroke in ((2.0, (0, 0, 0)), (1.0, (255, 255, 255)), (0.0, colour)):
            ring = size + round(more * 2**SUBPIXEL_BITS)
            cv2.circle(picture, fixed_point(point), ring, stroke, -1, cv2.LINE_AA, SUBPIXEL_BITS)
    else:
        cv2.circle(picture, fixed_point(point), size, (0, 0, 0), 4, cv2.LINE_AA, SUBPIXEL_BITS)
        cv2.circle(picture, fixed_point(point), size, colour, 2, cv2.LINE_AA, SUBPIXEL_BITS)


def cross(picture: np.ndarray, point: np.ndarray, colour: Colour, arm: float = 7.0) -> None:
    """Draw a diagonal cross; `arm` is half its width, pixels."""
    for thickness, stroke in ((4, (0, 0, 0)), (2, colour)):
        for direction in (np.array([arm, arm]), np.array([arm, -arm])):
            ends = fixed_point(point - direction), fixed_point(point + direction)
            cv2.line(picture, *ends, stroke, thickness, cv2.LINE_AA, SUBPIXEL_BITS)


def number(picture: np.ndarray, text: str, point: np.ndarray) -> None:
    """Write a number, its lower left corner at the point."""
    u, v = (int(x) for x in np.rint(point))
    cv2.putText(picture, text, (u, v), FONT, 0.45, (0, 0, 0), 3, cv2.LINE_AA)
    cv2.putText(picture, text, (u, v), FONT, 0.45, (255, 255, 255), 1, cv2.LINE_AA)


def polyline(picture: np.ndarray, points: np.ndarray, colour: Colour) -> None:
    """Draw a thin line through the points (n, 2); NaN breaks it."""
    for a, b in pairwise(points):
        if np.isfinite([*a, *b]).all():
            cv2.line(picture, fixed_point(a), fixed_point(b), colour, 1, cv2.LINE_AA, SUBPIXEL_BITS)


def ellipse(picture: np.ndarray, point: np.ndarray, covariance: np.ndarray, colour: Colour) -> None:
    """Draw the one-sigma ellipse of a covariance (2, 2), square pixels."""
    values, vectors = np.linalg.eigh(covariance)
    axes = np.sqrt(np.clip(values, 0, picture.shape[1] ** 2))
    angle = float(np.rad2deg(np.arctan2(vectors[1, 1], vectors[0, 1])))
    size = tuple(round(float(x) * 2**SUBPIXEL_BITS) for x in (axes[1], axes[0]))
    cv2.ellipse(picture, fixed_point(point), size, angle, 0, 360, colour, 1, cv2.LINE_AA, SUBPIXEL_BITS)
