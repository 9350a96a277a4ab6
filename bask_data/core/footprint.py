"""The part of a support plane that things can stand on, as far as the views tell."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy.ndimage import label
from scipy.spatial import ConvexHull, QhullError

from bask_data.core.planes import PATCH_CELL, plane_axes
from bask_data.core.sightings import PosedDepth, sighted

MOST_GROUND_CELLS = 1_000_000
"""Cells of a support beyond which hidden ground is not looked for: 20 x 20 m. Chosen to bound time."""


@dataclass(frozen=True)
class Footprint:
    """The convex hull of a support's surface, in the plane.

    The hull, not the surface itself, because the surface is hidden under the objects and behind them.

    Args:
        axes: perpendicular unit vectors that span the plane.
        edges: a x + b y + c <= 0 inside, (a, b) of unit length; without any, nothing is inside.
    """

    axes: Float[ndarray, "2 3"]
    edges: Float[ndarray, "e 3"]

    def outside(self, points_world: Float[ndarray, "n 3"]) -> Float[ndarray, "n"]:
        """Metres by which points lie beyond the hull's nearest edge, seen along the plane's normal; negative inside."""
        beyond = np.full(len(points_world), -np.inf if len(self.edges) else np.inf)
        at = points_world @ self.axes.T
        # One edge at a time, to save memory of the size points x edges.
        for edge in self.edges:
            np.maximum(beyond, at @ edge[:2] + edge[2], out=beyond)
        return beyond

    def above(self, points_world: Float[ndarray, "n 3"], margin: float = 0.0) -> Bool[ndarray, "n"]:
        """Points in the prism on the hull, widened by `margin` metres; a negative one narrows it."""
        return self.outside(points_world) <= margin


def footprint(
    plane: Float[ndarray, "4"],
    surface_world: Float[ndarray, "m 3"],
    areas: Float[ndarray, "m"],
    views: Sequence[PosedDepth] = (),
) -> Footprint:
    """The footprint of the heaviest connected part of a surface on a plane.

    A shelf at the same height does not extend the table; but parts that are divided only by ground hidden from all
    `views` are one: a row of objects and its shadow may cross the whole table.

    Args:
        surface_world: points on the plane, metres.
        areas: square metres that each represents.
    """
    axes = plane_axes(plane)
    nothing = Footprint(axes, np.zeros((0, 3)))
    xy = surface_world @ axes.T
    if len(xy) < 3:
        return nothing
    try:
        return Footprint(axes, ConvexHull(xy[connected_part(plane, xy, areas, views)]).equations)
    except QhullError:  # All in one line: no footprint, so nothing stands on it.
        return nothing


def connected_part(
    plane: Float[ndarray, "4"], xy: Float[ndarray, "m 2"], areas: Float[ndarray, "m"], views: Sequence[PosedDepth] = ()
) -> Bool[ndarray, "m"]:
    """Points of the heaviest connected part; ground hidden from all views connects."""
    lowest = xy.min(axis=0)
    cells = np.floor((xy - lowest) / PATCH_CELL).astype(np.int64)
    grid = np.zeros(cells.max(axis=0) + 1, bool)
    grid[cells[:, 0], cells[:, 1]] = True
    if views and grid.size <= MOST_GROUND_CELLS:
        empty = np.argwhere(~grid)
        centres = lowest + (empty + 0.5) * PATCH_CELL
        ground = centres @ plane_axes(plane) - plane[3] * plane[:3]
        grid[tuple(empty[sighted(ground, views).hidden].T)] = True
    parts = _parts(grid)[cells[:, 0], cells[:, 1]]
    return parts == np.bincount(parts, weights=areas).argmax()


def _parts(grid: Bool[ndarray, "a b"]) -> Int[ndarray, "a b"]:
    return np.asarray(label(grid, structure=np.ones((3, 3)))[0])
