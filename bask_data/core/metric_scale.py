"""The size of a reconstruction from images alone: metres per its unit, from measured depth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from bask_data.core.depth import SIGMA_FROM_MAD
from bask_data.core.geometry import in_image

EDGE_RADIUS = 2
"""Pixels around a point whose depth must be that of one plane: colour and depth of RGB-D cameras lie up to 3 pixels
apart, and features are found at edges. Sensitivity not measured."""

EDGE_STEP = 0.02
"""Largest difference of the sum of least and largest depth around a point from twice their median, as a share of it. At
an edge this is the step, on a plane 0 at any slope. Sensitivity not measured."""

STEEPEST = 0.1
"""Largest difference of depths around a point, as a share of their median: planes seen by f = 200 pixels, as phones'
depth is, have 0.1 at 80 degrees; more is an edge or grazed. Sensitivity not measured."""

LEAST_AROUND = 3
"""Measured pixels that are needed around a point; registered depth has holes. Sensitivity not measured."""

LEAST_RATIOS = 15
"""Points of an image that must have depth for the image to count. Chosen; sensitivity not measured."""


@dataclass(frozen=True)
class MetricScale:
    """Metres per unit of a model.

    Attributes:
        spread: standard deviation between images, as a share; robust.
        point_spread: standard deviation between points within images, as a share; robust.
        n_images, n_points: images, and observations of points in them, that count.
    """

    metres_per_unit: float
    spread: float
    point_spread: float
    n_images: int
    n_points: int


def depth_log_ratios(
    uv: Float[ndarray, "n 2"], z: Float[ndarray, " n"], depth: Float[ndarray, "h w"]
) -> Float[ndarray, " k"]:
    """log(measured depth / z of the model) at those of the points that lie on a measured surface, away from edges.

    Args:
        uv: pixels of the points; NaN for points that have no image.
        z: along the optical axis, units of the model.
        depth: metres, 0 = no measurement.
    """
    height, width = depth.shape
    inside = in_image(uv, height, width) & (z > 0)
    u, v = np.rint(uv[inside]).astype(int).T
    z = z[inside]
    offsets = np.arange(-EDGE_RADIUS, EDGE_RADIUS + 1)
    rows = np.clip(v[:, None, None] + offsets[:, None], 0, height - 1)
    columns = np.clip(u[:, None, None] + offsets, 0, width - 1)
    around = depth[rows, columns].reshape(len(u), offsets.size**2).astype(np.float64)
    kept = (around > 0).sum(axis=1) >= LEAST_AROUND
    around = np.where(around[kept] > 0, around[kept], np.nan)
    if not kept.any():
        return np.zeros(0)
    middle = np.nanmedian(around, axis=1)
    least, largest = np.nanmin(around, axis=1), np.nanmax(around, axis=1)
    is_plane = np.abs(least + largest - 2 * middle) <= EDGE_STEP * middle
    is_plane &= largest - least <= STEEPEST * middle
    return np.log(middle[is_plane] / z[kept][is_plane])


def metric_scale(log_ratios: Sequence[Float[ndarray, " _"]]) -> MetricScale | None:
    """Metres per unit from the log ratios of each image; None if no image has enough of them.

    Every image counts alike: the median of its points' ratios, and of these the median again.
    """
    counted = [ratios for ratios in log_ratios if len(ratios) >= LEAST_RATIOS]
    if not counted:
        return None
    medians = np.array([np.median(ratios) for ratios in counted])
    middle = np.median(medians)
    within = np.concatenate([np.abs(ratios - median) for ratios, median in zip(counted, medians, strict=True)])
    return MetricScale(
        metres_per_unit=float(np.exp(middle)),
        spread=float(SIGMA_FROM_MAD * np.median(np.abs(medians - middle))),
        point_spread=float(SIGMA_FROM_MAD * np.median(within)),
        n_images=len(counted),
        n_points=len(within),
    )
