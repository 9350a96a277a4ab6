"""What a few views tell of places in space: hidden behind something measured, or seen through."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32
from numpy import ndarray

from bask_data.core.depth import DEPTH_SLACK
from bask_data.core.geometry import in_image, invert_rigid, project, transform

N_FIT = 2000
"""Points of a surface by which a view is compared with it. Chosen to bound time, sensitivity not measured."""


@dataclass(frozen=True)
class PosedDepth:
    """One measured frame.

    Args:
        depth: z-depth, metres; 0 means no measurement, and such a pixel tells nothing.
    """

    depth: Float32[ndarray, "h w"]
    K: Float[ndarray, "3 3"]
    world_from_camera: Float[ndarray, "4 4"]

    @property
    def eye(self) -> Float[ndarray, "3"]:
        """The camera's centre, world."""
        return self.world_from_camera[:3, 3]

    def contradicted(
        self, points_world: Float[ndarray, "n 3"], slack: tuple[float, float] = DEPTH_SLACK
    ) -> tuple[int, int]:
        """Numbers of points of a surface that the frame measured, and that it sees through."""
        uv, z = project(transform(invert_rigid(self.world_from_camera), points_world), self.K)
        inside = in_image(uv, *self.depth.shape) & (z > 0)
        u, v = np.rint(uv[inside]).astype(int).T
        # Beside the outline of an object, the nearest pixel may miss it: the nearest of nine counts.
        around = np.ones((3, 3), np.uint8)
        nearest = cv2.erode(np.where(self.depth > 0, self.depth, np.float32(np.inf)), around)[v, u]
        farthest = cv2.dilate(self.depth, around)[v, u]
        z = z[inside]
        tolerance = slack[0] + slack[1] * z
        on = (nearest <= z + tolerance) & (farthest >= z - tolerance)
        return int(on.sum()), int((np.isfinite(nearest) & (nearest > z + tolerance)).sum())


@dataclass(frozen=True)
class PointSightings:
    """What views tell of points.

    Args:
        hidden: some view measured a surface in front of the point, and none measured anything behind it.
        passed: some view measured something behind the point: nothing is there.
        framed: inside the image of some view.
    """

    hidden: Bool[ndarray, "n"]
    passed: Bool[ndarray, "n"]
    framed: Bool[ndarray, "n"]


def sighted(
    points_world: Float[ndarray, "n 3"], views: Sequence[PosedDepth], slack: tuple[float, float] = DEPTH_SLACK
) -> PointSightings:
    """What the views tell of each point.

    Args:
        slack: (a, b): a measurement within a + b z metres of the point is of its own surface.
    """
    n = len(points_world)
    before, passed, framed = np.zeros(n, bool), np.zeros(n, bool), np.zeros(n, bool)
    for view in views:
        uv, z = project(transform(invert_rigid(view.world_from_camera), points_world), view.K)
        inside = in_image(uv, *view.depth.shape) & (z > 0)
        u, v = np.rint(uv[inside]).astype(int).T
        measured, z = view.depth[v, u], z[inside]
        tolerance = slack[0] + slack[1] * z
        before[inside] |= (measured > 0) & (measured < z - tolerance)
        passed[inside] |= measured > z + tolerance
        framed |= inside
    return PointSightings(before & ~passed, passed, framed)


def fitting(
    views: Sequence[PosedDepth], surface_world: Float[ndarray, "n 3"], n_points: int = N_FIT
) -> tuple[PosedDepth, ...]:
    """The views that measured the surface more often than they see through it; others tell nothing of it."""
    sample = surface_world[:: max(1, len(surface_world) // n_points)].astype(np.float64)
    counts = [view.contradicted(sample) for view in views]
    return tuple(view for view, (n_on, n_through) in zip(views, counts, strict=True) if n_on > n_through)
