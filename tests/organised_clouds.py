"""Organised point clouds: PCD files as a depth camera's single view leaves them, and the surface they show."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bask_data.formats import pcd

SIZE = (480, 640)
CAMERA = (525.0, 525.0, 319.5, 239.5)
"""fx, fy, cx, cy in pixels of the depth cameras whose drivers wrote such files, whatever the lens: the driver made the
points with them."""


@dataclass(frozen=True)
class OrganisedCloud:
    """What a PCD file holds, as images.

    Args:
        points: (h, w, 3) float32, metres, camera frame; NaN where there is none.
        label: (h, w) uint32, 0 where there is no point; or None without labels.
    """

    points: np.ndarray
    label: np.ndarray | None


def read_pcd(file: Path) -> OrganisedCloud:
    """A depth camera's cloud.

    A file that lists its points instead (height 1) is made an image of `SIZE` again: `CAMERA` saw them.

    Raises:
        BadData: the file is something else, is cut short, or its compressed data is broken.
    """
    cloud = pcd.read_pcd(file)
    height, width = cloud.height, cloud.width
    points = np.stack([cloud.columns[axis].astype(np.float32) for axis in "xyz"], axis=-1)
    label = cloud.columns.get("label")
    where: tuple[np.ndarray, ...] = np.unravel_index(np.arange(width * height), (height, width))
    if height == 1:
        (height, width), where = SIZE, _pixels(points)
    image, labels = np.full((height, width, 3), np.nan, np.float32), np.zeros((height, width), np.uint32)
    image[where] = points
    if label is not None:
        labels[where] = label
    return OrganisedCloud(image, None if label is None else labels)


def _pixels(points: np.ndarray) -> tuple[np.ndarray, ...]:
    """Row and column in an image of `SIZE` of points (n, 3) in the camera frame."""
    fx, fy, cx, cy = CAMERA
    u, v = fx * points[:, 0] / points[:, 2] + cx, fy * points[:, 1] / points[:, 2] + cy
    return tuple(np.rint(np.stack([v, u])).astype(int).clip(0, np.array(SIZE)[:, None] - 1))


def surface_of(points: np.ndarray, slack: tuple[float, float] = (0.005, 0.01)) -> tuple[np.ndarray, np.ndarray]:
    """(n, 3) float32 vertices, row by row, and (m, 3) int32 triangles between neighbouring pixels at like depths.

    Corners run counter-clockwise as the camera sees them.

    Args:
        points: (h, w, 3), NaN where there is none.
        slack: (a, b) of the a + b z metres that neighbours on one surface differ in depth.
    """
    valid = np.isfinite(points).all(axis=2)
    number = np.cumsum(valid).reshape(valid.shape) - 1
    corner = (slice(None, -1), slice(1, None))
    a, b, c, d = ((rows, columns) for rows in corner for columns in corner)
    triangles = []
    for first, second, third in ((a, c, b), (b, c, d)):
        z = np.stack([points[one][..., 2] for one in (first, second, third)], axis=-1)
        whole = valid[first] & valid[second] & valid[third]
        near = np.ptp(np.where(whole[..., None], z, 0), axis=-1) < slack[0] + slack[1] * np.where(whole, z[..., 0], 0)
        triangles.append(np.stack([number[one][whole & near] for one in (first, second, third)], axis=-1))
    return points[valid].astype(np.float32), np.concatenate(triangles).astype(np.int32)
