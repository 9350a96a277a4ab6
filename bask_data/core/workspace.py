"""Estimation of a scan's workspace from a few points of a few frames."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from jaxtyping import Bool, Float, Float32
from numpy import ndarray

from bask_data.core.footprint import Footprint
from bask_data.core.geometry import transform, unproject
from bask_data.core.planes import height

TALLEST = 0.6
"""Metres above a support beyond which nothing stands on it. Assumes a tabletop. Chosen, sensitivity not measured."""


def sampled_points(
    depth: Float32[ndarray, "h w"],
    K: Float[ndarray, "3 3"],
    world_from_camera: Float[ndarray, "4 4"],
    n_points: int = 5000,
) -> Float[ndarray, "n 3"]:
    """About `n_points` measured points of a frame, world frame, evenly over its measured pixels, also of sensors that
    measure every other pixel only."""
    v, u = np.nonzero(depth)
    step = max(1, len(v) // n_points)
    v, u = v[::step], u[::step]
    points = unproject(np.stack([u, v], axis=-1).astype(np.float64), depth[v, u].astype(np.float64), K)
    return transform(world_from_camera, points)


def workspace_on(
    support: Float[ndarray, "4"],
    vertices: Float[ndarray, "n 3"],
    on_support: Bool[ndarray, "n"],
    ground: Footprint,
    margin: float = 0.02,
) -> Float[ndarray, "2 3"]:
    """The box (2, 3) around a support and what stands on it, lowest and highest corner, world frame, metres.

    Args:
        support: plane; n towards the objects.
        vertices: of the whole surface, metres, world.
        on_support: those on the plane.
        ground: the part of the plane that things can stand on.
        margin: metres added on each side; the default assumes a tabletop.
    """
    raised = height(vertices, support)
    over = ground.above(vertices)
    chosen = over & (on_support | ((raised > 0) & (raised < TALLEST)))
    inside = vertices[chosen]
    lowest, highest = np.percentile(inside, [0.1, 99.9], axis=0)
    return np.stack([lowest - margin, highest + margin])


def estimated_workspace(
    clouds_world: Iterable[Float[ndarray, "_ 3"]],
    cell: float = 0.05,
    min_share: float = 0.2,
    margin: float = 0.02,
    origin: Float[ndarray, "3"] | None = None,
) -> Float[ndarray, "2 3"] | None:
    """The box (2, 3) around what several frames see, lowest and highest corner, world frame, metres; None without any
    measurement.

    Space is divided into cells; a cell counts when at least two frames and `min_share` of all frames measured a point
    in it, which excludes a far wall that few frames see. On every axis, the box holds 99 % of the points in such cells.
    When no cells are shared, all points count.

    Args:
        clouds_world: points of each frame, metres (`sampled_points`).
        cell: edge of a cell, metres; the default assumes a tabletop, as does that of `margin`.
        margin: metres added on each side.
        origin: point of the world where cells begin. If it moves with the scene, so does the box.
    """
    clouds = [cloud for cloud in clouds_world if len(cloud)]
    if not clouds:
        return None
    points = np.concatenate(clouds)
    begun = points if origin is None else points - origin
    cells, i_cell = np.unique(np.floor(begun / cell).astype(np.int64), axis=0, return_inverse=True)
    i_cell = i_cell.reshape(-1)
    i_frame = np.repeat(np.arange(len(clouds)), [len(cloud) for cloud in clouds])
    n_frames = np.bincount(np.unique(i_cell * len(clouds) + i_frame) // len(clouds), minlength=len(cells))
    shared = n_frames >= min(len(clouds), max(2, int(np.ceil(min_share * len(clouds)))))
    agreed = points[shared[i_cell]] if shared.any() else points
    lowest, highest = np.percentile(agreed, [0.5, 99.5], axis=0)
    return np.stack([lowest - margin, highest + margin])
