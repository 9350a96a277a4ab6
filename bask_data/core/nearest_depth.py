"""Depth where none was measured, and at another resolution: always one that was measured nearby, never an average."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float
from numpy import ndarray


def fill_depth(depth: Float[ndarray, "h w"]) -> Float[ndarray, "h w"]:
    """Depth with each missing value taken from the nearest measured pixel; NaN everywhere if there is none."""
    missing = depth <= 0
    if not missing.any():
        return depth.copy()
    if missing.all():
        return np.full_like(depth, np.nan)
    _, label = cv2.distanceTransformWithLabels(
        missing.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    depth_of_label = np.zeros(label.max() + 1, dtype=depth.dtype)
    depth_of_label[label[~missing]] = depth[~missing]
    return depth_of_label[label]


def shrink_depth(depth: Float[ndarray, "h w"], size: tuple[int, int]) -> Float[ndarray, "h2 w2"]:
    """Depth at another resolution: measured at the new pixel's centre, or else the nearest surface within the pixel.

    Depths are never averaged, because there is no surface between foreground and background.

    Args:
        size: (height, width). May also be larger, the pixels then repeat.
    """
    height, width = depth.shape
    if size == (height, width):
        return depth
    v = np.minimum(((np.arange(size[0]) + 0.5) * height / size[0]).astype(int), height - 1)
    u = np.minimum(((np.arange(size[1]) + 0.5) * width / size[1]).astype(int), width - 1)
    shrunk = depth[np.ix_(v, u)]
    missing = shrunk <= 0
    if missing.any() and (size[0] < height or size[1] < width):
        far = np.where(depth > 0, depth, np.inf)
        v_edge = np.minimum((np.arange(size[0]) * height / size[0]).astype(int), height - 1)
        u_edge = np.minimum((np.arange(size[1]) * width / size[1]).astype(int), width - 1)
        nearest = np.minimum.reduceat(np.minimum.reduceat(far, v_edge, axis=0), u_edge, axis=1)
        shrunk = np.where(missing, np.where(np.isfinite(nearest), nearest, 0), shrunk).astype(depth.dtype)
    return shrunk
