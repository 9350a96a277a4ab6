"""Visibility of static points: the ground truth that a recording of a static scene provides for its keypoints."""

from __future__ import annotations

from enum import IntEnum

import numpy as np
from jaxtyping import Float, Int8
from numpy import ndarray

from bask_data.core.geometry import in_image, project


class Visibility(IntEnum):
    """State of a point for one camera in one frame."""

    OUT_OF_VIEW = 0
    OCCLUDED = 1
    """Something was measured clearly in front of it."""
    VISIBLE = 2
    UNKNOWN = 3
    """No depth was measured there, or one clearly behind it."""


def visibility(
    points_world: Float[ndarray, "n 3"],
    depth: Float[ndarray, "h w"],
    K: Float[ndarray, "3 3"],
    world_from_camera: Float[ndarray, "4 4"],
    tolerance: float,
) -> Int8[ndarray, "n"]:
    """The `Visibility` of static points in a frame, by measured depth.

    Args:
        depth: z-depth, metres; 0 means no measurement.
        tolerance: metres by which measured and true depth may differ for a point to count as visible; should exceed the
            sensor's noise and the poses' error together.

    Raises:
        ValueError: `tolerance` is negative.
    """
    if tolerance < 0:
        raise ValueError(f"tolerance: expected >= 0 metres, got {tolerance}")
    height, width = depth.shape
    uv, z = project((points_world - world_from_camera[:3, 3]) @ world_from_camera[:3, :3], K)
    inside = in_image(uv, height, width)
    u, v = np.rint(uv[inside]).astype(int).clip(0, [width - 1, height - 1]).T
    measured, z = depth[v, u], z[inside]
    seen = np.full(len(z), Visibility.UNKNOWN, dtype=np.int8)
    seen[(measured > 0) & (measured < z - tolerance)] = Visibility.OCCLUDED
    seen[(measured > 0) & (np.abs(measured - z) <= tolerance)] = Visibility.VISIBLE
    result = np.full(len(points_world), Visibility.OUT_OF_VIEW, dtype=np.int8)
    result[inside] = seen
    return result
