"""Reasons to doubt that a cluster is an object on the support, and how much of it was seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray
from scipy.spatial import ConvexHull, QhullError, cKDTree

from bask_data.core.background import Background
from bask_data.core.geometry import in_image, invert_rigid, project, transform
from bask_data.core.planes import height
from bask_data.core.sightings import PosedDepth, sighted

Doubt = Literal["cut", "floating", "with-camera", "flat"]
"""Cut by the border of what was seen; not standing on the support; moves with the camera; flat on the support."""
N_CHECKED = 400
"""Most points of an object that the views are asked about. Chosen to bound time, sensitivity not measured."""
N_ON_HULL = 400
"""Points on the hull of an object by which its seen share is estimated, so to some 2 %. Chosen."""
CUT_SHARE = 0.02
"""Least share of an object's points on the border of the workspace or of an image. Chosen, sensitivity not measured."""
BORDER_PX = 2.0
"""Pixels from the edge of an image within which an object is cut. Chosen, sensitivity not measured."""
BORDER_VOXELS = 2.5
"""Voxels from the side of the workspace within which an object is cut: fusion gives no surface in the last ones.
Chosen, sensitivity not measured."""
SHOWN_SHARE = 0.2
"""Least share of an object's points in an image for it to tell whether the object is cut. Chosen, sensitivity not
measured."""
CLEARANCE = 0.03
"""Metres between the support and the lowest point of an object above which it may not stand there. Assumes a tabletop.
Chosen, sensitivity not measured."""
ON_ANOTHER = 0.02
"""Metres between an object and another that it may stand on. Assumes a tabletop. Chosen, sensitivity not measured."""
CLEAR_SHARE = 0.3
"""Share of the space below an object that must be seen to be empty for it not to stand. Chosen, sensitivity not
measured."""
CONTRADICTED = 0.5
"""Share of the measurements at an object's surface that pass through it, from which it is not static. Chosen,
sensitivity not measured."""
FLAT = 0.01
"""Metres; what is not higher, and level, may be the support's own unevenness. Assumes a tabletop. Chosen, sensitivity
not measured."""
LEVEL_SHARE = 0.9
"""Least share of level surface of something flat. Chosen, sensitivity not measured."""
FACES_DOWN = -0.5
"""Cosine to the support's normal below which a face is an underside, which nobody sees. Chosen."""

FACES_BACK = 0.3
"""Cosine to the line of sight from which surface is seen rather than grazed. Chosen, sensitivity not measured."""


@dataclass(frozen=True)
class SeenScene:
    """What the doubts of all objects are judged by.

    Args:
        views: some frames of all cameras.
        bounds: lowest and highest corner of the workspace, metres, world; None if unknown.
        all_objects: whether the user said that everything in the workspace is objects, so nothing is doubted.
    """

    background: Background
    voxel_size: float
    views: Sequence[PosedDepth] = ()
    bounds: Float[ndarray, "2 3"] | None = None
    all_objects: bool = False


def doubts_of(
    points: Float[ndarray, "n 3"],
    normals: Float[ndarray, "n 3"],
    scene: SeenScene,
    others: Float[ndarray, "m 3"],
) -> tuple[Doubt, ...]:
    """The reasons to doubt an object.

    Args:
        points: its vertices, metres, world.
        normals: unit, towards the cameras.
        others: vertices of the other objects, on which it may stand.
    """
    if scene.all_objects:
        return ()
    chosen = np.unique(np.linspace(0, len(points) - 1, N_CHECKED).round().astype(int))
    sample = points[chosen].astype(np.float64)
    found: list[Doubt] = []
    if is_cut(sample, scene):
        found.append("cut")
    if scene.background.support is not None:
        plane = scene.background.support.plane
        if is_floating(points, plane, scene.views) and not touches(sample, others):
            found.append("floating")
        level = float((normals @ plane[:3] > np.sqrt(0.5)).mean())
        if np.percentile(height(points, plane), 98) < FLAT and level > LEVEL_SHARE:
            found.append("flat")
    if moves_with_camera(sample, scene.views):
        found.append("with-camera")
    return tuple(found)


def is_cut(points: Float[ndarray, "n 3"], scene: SeenScene) -> bool:
    """Whether an object reaches a side of the workspace, or the border of every image that shows much of it."""
    if scene.bounds is not None:
        near = np.minimum(points - scene.bounds[0], scene.bounds[1] - points) < BORDER_VOXELS * scene.voxel_size
        # The lowest side is below the support: what stands near it is not cut.
        if scene.background.support is not None:
            normal = scene.background.support.plane[:3]
            sides = np.abs(normal) < np.cos(np.deg2rad(30))
            near = near[:, sides]
        if near.any(axis=1).mean() >= CUT_SHARE:
            return True
    shares = [share for view in scene.views if (share := _border_share(points, view)) is not None]
    return bool(shares) and min(shares) >= CUT_SHARE


def _border_share(points: Float[ndarray, "n 3"], view: PosedDepth) -> float | None:
    """Share of the points in an image that lie along its border; None if it shows too few of them to tell."""
    uv, z = project(transform(invert_rigid(view.world_from_camera), points), view.K)
    h, w = view.depth.shape
    inside = in_image(uv, h, w) & (z > 0)
    if inside.mean() < SHOWN_SHARE:
        return None
    u, v = uv[inside].T
    return float((np.minimum(np.minimum(u, w - 1 - u), np.minimum(v, h - 1 - v)) < BORDER_PX).mean())


def is_floating(points: Float[ndarray, "n 3"], plane: Float[ndarray, "4"], views: Sequence[PosedDepth]) -> bool:
    """Whether an object begins well above the support, and nothing hides the space below it."""
    heights = height(points, plane)
    bottom = float(np.percentile(heights, 2))
    if bottom < CLEARANCE or not views:
        return False
    lowest = points[heights <= np.percentile(heights, 20)].astype(np.float64)
    lowest = lowest[:: -(-len(lowest) // N_CHECKED)]
    drop = height(lowest, plane)[:, None, None] * np.array([0.3, 0.5, 0.7, 0.9])[:, None]
    below = lowest[:, None] - drop * plane[:3]
    return bool(sighted(below.reshape(-1, 3), views).passed.mean() > CLEAR_SHARE)


def touches(points: Float[ndarray, "n 3"], others: Float[ndarray, "m 3"]) -> bool:
    """Whether an object comes so near to others that it may stand on them."""
    return bool(len(others)) and bool(cKDTree(others).query(points)[0].min() < ON_ANOTHER)


def moves_with_camera(points: Float[ndarray, "n 3"], views: Sequence[PosedDepth]) -> bool:
    """Whether most measurements at the places of an object's surface pass through it: it was there in few frames only,
    as something that is fixed to a moving camera is."""
    counts = np.array([view.contradicted(points) for view in views]).reshape(-1, 2).sum(axis=0)
    n_on, n_passed = counts.tolist()
    return bool(n_passed > CONTRADICTED * (n_on + n_passed))


def seen_share(
    points: Float[ndarray, "n 3"],
    normals: Float[ndarray, "n 3"],
    plane: Float[ndarray, "4"] | None,
    reach: float,
    rng: np.random.Generator,
) -> float:
    """Share of an object's closed surface that was seen, without its underside; from a sample.

    The closed surface is the convex hull of what was seen and its shadow on the support. A point on it was seen if
    looking in from there meets surface that faces outwards. What a hull closes beyond the last surface seen is smaller
    than the object, so the share is an upper bound.

    Args:
        reach: metres beside the line of sight within which surface is met.
    """
    own = points[:: -(-len(points) // (5 * N_ON_HULL))].astype(np.float64)
    facing = normals[:: -(-len(points) // (5 * N_ON_HULL))].astype(np.float64)
    closed = own if plane is None else np.concatenate([own, own - height(own, plane)[:, None] * plane[:3]])
    try:
        hull = ConvexHull(closed)
    except (QhullError, ValueError):  # Flat, or fewer than four points.
        return 0.0
    corners = closed[hull.simplices]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    if plane is not None:
        area = np.where(hull.equations[:, :3] @ plane[:3] < FACES_DOWN, 0.0, area)
    if not area.sum() > 0:
        return 0.0
    facet = rng.choice(len(area), size=N_ON_HULL, p=area / area.sum())
    weights = rng.dirichlet(np.ones(3), size=N_ON_HULL)
    on_hull = np.einsum("ij,ijk->ik", weights, corners[facet])
    return float(_met(on_hull, hull.equations[facet, :3], own, facing, reach).mean())


def _met(
    starts: Float[ndarray, "k 3"],
    outward: Float[ndarray, "k 3"],
    points: Float[ndarray, "n 3"],
    normals: Float[ndarray, "n 3"],
    reach: float,
) -> Bool[ndarray, "k"]:
    """Whether a look inwards from each start passes within `reach` metres of surface that faces it."""
    met = np.zeros(len(starts), bool)
    for i, (start, direction) in enumerate(zip(starts, outward, strict=True)):
        offset = points - start
        depth = offset @ direction
        beside = np.einsum("ij,ij->i", offset, offset) - depth**2
        met[i] = ((beside < reach**2) & (normals @ direction > FACES_BACK)).any()
    return met
