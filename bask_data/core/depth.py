"""Cleaning of measured depth images."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float32
from numpy import ndarray

DEPTH_SLACK = (0.01, 0.01)
"""(a, b): neighbouring pixels on one surface differ by less than a + b z metres, for noise and slope. Assumes a
tabletop. Chosen, sensitivity not measured."""

NOISE_SIGMAS = 4.0
"""Standard deviations of the sensor's noise by which neighbours on one surface may differ, if that is more. Chosen,
sensitivity not measured."""


SIGMA_FROM_MAD = 1.4826
"""Standard deviation of a normal distribution per median absolute deviation."""


def in_range(depth: Float32[ndarray, "h w"], near: float, far: float) -> Float32[ndarray, "h w"]:
    """The depth with everything outside [near, far] set to not measured.

    Args:
        near, far: metres.

    Raises:
        ValueError: `near` is negative or not below `far`.
    """
    if not 0 <= near < far:
        raise ValueError(f"depth range: expected 0 <= near < far metres, got near {near}, far {far}")
    # NaN and infinity fail a comparison, so files that mark missing depth with them work, too.
    return np.where((depth >= near) & (depth <= far), depth, np.float32(0))


def flying(
    depth: Float32[ndarray, "h w"], radius: int = 2, slack: tuple[float, float] = DEPTH_SLACK
) -> Bool[ndarray, "h w"]:
    """Flying pixels: measurements between a near and a far surface at an edge, and isolated ones.

    A pixel on a surface agrees with the nearest or with the farthest of its measured neighbours, whichever side of an
    edge it is on; one that agrees with neither is on no surface. Parts one pixel thin are kept, which removing every
    edge would not.

    Args:
        radius: half the window, pixels; 2 spans the gaps of depth that was registered to colour and covers every other
            pixel only.
        slack: (a, b): neighbours on one surface differ by at most a + b z metres; more on a noisy sensor.

    Raises:
        ValueError: `radius` is less than a pixel.
    """
    if radius < 1:
        raise ValueError(f"radius: expected at least 1 pixel, got {radius}")
    around = np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)
    around[radius, radius] = 0
    measured = depth > 0
    far_away = np.float32(np.inf)
    nearest = cv2.erode(
        np.where(measured, depth, far_away), around, borderType=cv2.BORDER_CONSTANT, borderValue=float("inf")
    )
    farthest = cv2.dilate(depth, around, borderType=cv2.BORDER_CONSTANT, borderValue=0.0)
    tolerance = np.maximum(
        np.float32(slack[0]) + np.float32(slack[1]) * depth, np.float32(NOISE_SIGMAS * noise_share(depth)) * depth
    )
    # A pixel with no measured neighbour has nearest = infinity and farthest = 0, and agrees with neither.
    return measured & (np.abs(depth - nearest) > tolerance) & (np.abs(depth - farthest) > tolerance)


def noise_share(depth: Float32[ndarray, "h w"], n_least: int = 1000) -> float:
    """Standard deviation of a depth image's noise as a share of the depth, from the differences of adjacent pixels; 0
    with fewer than `n_least` of these.

    More than half of all differences are within one surface, so their median is insensitive to edges.
    """
    rows = depth[::4]
    for step in (1, 2):  # Depth that was registered to colour may miss every other column.
        left, right = rows[:, :-step], rows[:, step:]
        both = (left > 0) & (right > 0)
        if np.count_nonzero(both) >= n_least:
            change = np.abs(left[both] - right[both]) / left[both]
            # The difference of two measurements has sqrt(2) times the noise of one.
            return float(SIGMA_FROM_MAD * np.median(change) / np.sqrt(2))
    return 0.0


def filled(depth: Float32[ndarray, "h w"], slack: tuple[float, float] = DEPTH_SLACK) -> Float32[ndarray, "h w"]:
    """The depth with gaps of one pixel inside a surface closed by the mean of the measured pixels around.

    Depth that was registered to colour misses whole rows and columns; voxels that fall into such gaps in most frames
    would leave holes in the surface. A gap is inside a surface when at least four of the eight pixels around it are
    measured and agree; beyond the edge of a surface at most three are.

    Args:
        slack: (a, b): depths of one surface differ by at most a + b z metres.
    """
    measured = depth > 0
    window = (3, 3)
    n_around = cv2.boxFilter(measured.astype(np.float32), -1, window, normalize=False, borderType=cv2.BORDER_CONSTANT)
    gap = ~measured & (n_around > 3.5)
    if not gap.any():
        return depth
    total = cv2.boxFilter(depth, -1, window, normalize=False, borderType=cv2.BORDER_CONSTANT)
    mean = total / np.maximum(n_around, np.float32(1))
    around = np.ones((3, 3), np.uint8)
    far_away = np.where(measured, depth, np.float32(np.inf))
    spread = cv2.dilate(depth, around) - cv2.erode(far_away, around)
    inside = gap & (spread <= np.float32(slack[0]) + np.float32(slack[1]) * mean)
    return np.where(inside, mean, depth)


def cleaned(
    depth: Float32[ndarray, "h w"], near: float, far: float, slack: tuple[float, float] = DEPTH_SLACK
) -> Float32[ndarray, "h w"]:
    """Depth within [near, far] metres, without flying pixels and with gaps of one pixel closed."""
    kept = in_range(depth, near, far)
    return filled(np.where(flying(kept, slack=slack), np.float32(0), kept), slack)
