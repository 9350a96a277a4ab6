"""Depth and colour of different pixels brought onto the same ones."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8
from numpy import ndarray

from bask_data.core.geometry import in_image, pixel_grid, project, transform, unproject


def registered_depth(
    depth: Float32[ndarray, "h w"],
    depth_K: Float[ndarray, "3 3"],
    color_K: Float[ndarray, "3 3"],
    color_size: tuple[int, int],
    color_from_depth: Float[ndarray, "4 4"],
) -> Float32[ndarray, "H W"]:
    """Depth of another camera as the colour camera sees it, metres, 0 = none: the nearest point at each pixel."""
    seen = depth > 0
    points = unproject(pixel_grid(*depth.shape)[seen], depth[seen].astype(np.float64), depth_K)
    uv, z = project(transform(color_from_depth, points), color_K)
    inside = in_image(uv, *color_size)
    u, v = np.rint(uv[inside]).astype(int).T
    nearest = np.full(color_size, np.inf, np.float32)
    np.minimum.at(nearest, (v, u), z[inside].astype(np.float32))
    return np.where(np.isfinite(nearest), nearest, np.float32(0))


def color_at_depth_size(
    rgb: UInt8[ndarray, "H W 3"],
    color_K: Float[ndarray, "3 3"],
    depth_K: Float[ndarray, "3 3"],
    depth_size: tuple[int, int],
) -> UInt8[ndarray, "h w 3"]:
    """Colour at the pixels of depth of the same camera; averaged over each pixel's area where it shrinks."""
    shrink = max(1, round(color_K[0, 0] / depth_K[0, 0]))
    smooth = cv2.blur(rgb, (shrink, shrink)) if shrink > 1 else rgb
    return _looked_up(smooth, color_K, depth_K, depth_size, cv2.INTER_LINEAR)


def labels_at_depth_size(
    labels: UInt8[ndarray, "H W"],
    color_K: Float[ndarray, "3 3"],
    depth_K: Float[ndarray, "3 3"],
    depth_size: tuple[int, int],
) -> UInt8[ndarray, "h w"]:
    """Labels of colour's pixels at the pixels of depth of the same camera, from the nearest one."""
    return _looked_up(labels, color_K, depth_K, depth_size, cv2.INTER_NEAREST)


def _looked_up(
    image: ndarray, color_K: Float[ndarray, "3 3"], depth_K: Float[ndarray, "3 3"], size: tuple[int, int], how: int
) -> ndarray:
    height, width = size
    u = (np.arange(width) - depth_K[0, 2]) / depth_K[0, 0] * color_K[0, 0] + color_K[0, 2]
    v = (np.arange(height) - depth_K[1, 2]) / depth_K[1, 1] * color_K[1, 1] + color_K[1, 2]
    grid_u, grid_v = np.meshgrid(u.astype(np.float32), v.astype(np.float32))
    return cv2.remap(image, grid_u, grid_v, how, borderMode=cv2.BORDER_CONSTANT)
