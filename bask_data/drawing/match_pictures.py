"""Pictures of matches: two images side by side, joined by lines."""

from __future__ import annotations

import cv2
import numpy as np

from bask_data.core.geometry import scale_pixels
from bask_data.drawing.colours import palette
from bask_data.drawing.images import resize
from bask_data.drawing.strokes import SUBPIXEL_BITS, dot, fixed_point


def spread_matches(instance: np.ndarray, n_wanted: int) -> np.ndarray:
    """Indices of the matches to draw: a random sample with a fixed seed, balanced over instances."""
    order = np.random.default_rng(0).permutation(len(instance))
    rank = np.zeros(len(instance), dtype=np.int64)
    for i in np.unique(instance):
        mine = order[instance[order] == i]
        rank[mine] = np.arange(len(mine))
    return np.sort(order[np.argsort(rank[order], kind="stable")][:n_wanted])


def matches_picture(rgb_a: np.ndarray, rgb_b: np.ndarray, uv_a: np.ndarray, uv_b: np.ndarray, width: int) -> np.ndarray:
    """Two images side by side, with each match as a line in a colour of its own."""
    gap = 6
    left, right = resize(rgb_a, (width - gap) // 2), resize(rgb_b, (width - gap) // 2)
    height = max(len(left), len(right))
    picture = np.full((height, left.shape[1] + gap + right.shape[1], 3), 255, np.uint8)
    picture[: len(left), : left.shape[1]] = left
    picture[: len(right), left.shape[1] + gap :] = right
    start = scale_pixels(uv_a.astype(np.float64), rgb_a.shape[:2], left.shape[:2])
    end = scale_pixels(uv_b.astype(np.float64), rgb_b.shape[:2], right.shape[:2])
    end[:, 0] += left.shape[1] + gap
    for a, b, colour in zip(start, end, palette(len(start)), strict=True):
        cv2.line(picture, fixed_point(a), fixed_point(b), colour, 1, cv2.LINE_AA, SUBPIXEL_BITS)
        for point in (a, b):
            dot(picture, point, 3.0, colour)
    return picture
