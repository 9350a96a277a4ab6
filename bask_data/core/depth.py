"""Cleaning of measured depth images."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float32
from numpy import ndarray

DEPTH_SLACK = (0.01, 0.01)
"""Two neighbours on one surface differ by less than a + b z: 1 cm of noise and slope up close, and the noise that
grows with the distance."""

NOISE_SIGMAS = 4.0
"""Neighbours on one surface also differ by less than this many standard deviations of the sensor's noise: in the window
of a pixel the nearest and the farthest neighbour are about two away from it, each with noise of its own."""


SIGMA_FROM_MAD = 1.4826
"""Standard deviation of a normal distribution per median absolute deviation."""


def in_range(depth: Float32[ndarray, "h w"], near: float, far: float) -> Float32[ndarray, "h w"]:
    """The depth with everything outside [near, far] taken for not measured.

    Args:
        near: metres; what is nearer is the robot's own gripper.
        far: metres; what is farther is noise.

    Raises:
        ValueError: `near` is negative or not below `far`.
    """
    if not 0 <= near < far:
        raise ValueError(f"depth range: expected 0 <= near < far metres, got near {near}, far {far}")
    # NaN and infinity fail both comparisons, so files that mark missing depth with them are treated alike.
    return np.where((depth >= near) & (depth <= far), depth, np.float32(0))


def flying(
    depth: Float32[ndarray, "h w"], radius: int = 2, slack: tuple[float, float] = DEPTH_SLACK
) -> Bool[ndarray, "h w"]:
    """Measurements that belong to no surface: they hang between a near and a far one at its edge, or stand alone.

    A pixel on a surface agrees with the nearest or with the farthest of its measured neighbours, on whichever side of
    an edge it is; so
    parts one pixel thin stay whole, which a cut along every edge would eat. What agrees with neither is no surface.

    Args:
        radius: pixels; 2 reaches across the gaps of depth that was registered to colour and so covers every other
            pixel.
        slack: (a, b) of the a + b z metres by which neighbours on one surface may differ; more on a noisy sensor.
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
    """Standard deviation of a depth image's noise as a share of the depth, from the differences of pixels side by side;
    0 with fewer than `n_least` of these.

    Half of all differences are on one surface wherever there are surfaces, so their median knows nothing of edges.
    """
    rows = depth[::4]
    for step in (1, 2):  # Depth that was registered to colour may miss every other column.
        left, right = rows[:, :-step], rows[:, step:]
        both = (left > 0) & (right > 0)
        if np.count_nonzero(both) >= n_least:
            change = np.abs(left[both] - right[both]) / left[both]
            # The difference of two has the square root of two times the noise of one.
            return float(SIGMA_FROM_MAD * np.median(change) / np.sqrt(2))
    return 0.0


def filled(depth: Float32[ndarray, "h w"], slack: tuple[float, float] = DEPTH_SLACK) -> Float32[ndarray, "h w"]:
    """The depth with the gaps of a pixel inside a surface closed by the mean of the measured pixels around.

    Depth that was registered to colour misses whole rows and columns. A voxel falls into such a gap in most frames, and
    the surface gets holes. A gap counts as inside when half of the eight pixels around it are measured, and these
    agree;
    beyond the edge of a surface at most three are.
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
    """Depth within [near, far] metres, without flying pixels and without the gaps of a pixel inside a surface."""
    kept = in_range(depth, near, far)
    return filled(np.where(flying(kept, slack=slack), np.float32(0), kept), slack)
