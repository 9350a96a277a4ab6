"""Planes in a surface: their position, their noise, and the points above them.

Planes are (4,) float64 [nx, ny, nz, d] with |n| = 1 and n.x + d = 0; n points to the side that the surface was seen
from, where the objects are, so `height` is positive above the support.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray
from scipy.ndimage import label
from scipy.spatial import ConvexHull, QhullError

from bask_data.core.depth import SIGMA_FROM_MAD

SAME_FACING = np.cos(np.deg2rad(30.0))
"""Cosine of the angle between normals up to which a vertex belongs to a plane; others belong to something that cuts
through it. Chosen, sensitivity not measured."""
N_HYPOTHESES = 8192
"""Triples drawn for one plane. Chosen, sensitivity not measured."""
N_SCORED = 512
"""Most of these planes whose inliers are counted. Chosen to bound time, sensitivity not measured."""
N_SCORING_POINTS = 20_000
"""Points, drawn by area, among which inliers are counted. Chosen, sensitivity not measured."""
CHUNK = 64
"""Planes scored at once. Chosen to bound memory; it changes no result."""
UNLIKELY = 0.1
"""Least factor on the area of a plane that faces away from the guessed up: it must be ten times as large. Chosen,
sensitivity not measured."""
PATCH_CELL = 0.02
"""Metres; parts of a plane further apart are different surfaces at the same height. Assumes a tabletop. Chosen,
sensitivity not measured."""


@dataclass(frozen=True)
class Plane:
    """A plane found in a surface.

    Args:
        plane: [nx, ny, nz, d], world, n towards the side it was seen from.
        noise: standard deviation of the surface about the plane, metres.
        area: square metres of surface on it.
    """

    plane: Float[ndarray, "4"]
    noise: float
    area: float


@dataclass(frozen=True)
class PlaneSearch:
    """Settings of `find_planes`.

    Args:
        inlier: metres from a plane within which points are its inliers. The default assumes a depth camera with 2 to 5
            mm of noise at a metre.
        up: unit vector; only planes that face it within 30 degrees are searched.
        guess_up: unit vector; planes are ordered by area times the cosine to it, or by area alone without it.
        n_planes: greatest number of planes.
        min_share: least share of the surface's area on a plane.
    """

    inlier: float = 0.01
    up: Float[ndarray, "3"] | None = None
    guess_up: Float[ndarray, "3"] | None = None
    n_planes: int = 4
    min_share: float = 0.03


def height(points_world: Float[ndarray, "n 3"], plane: Float[ndarray, "4"]) -> Float[ndarray, "n"]:
    """Signed distance from the plane, metres, positive on the side of its normal."""
    return points_world @ plane[:3] + plane[3]


def fit_plane(points_world: Float[ndarray, "n 3"], weights: Float[ndarray, "n"]) -> Float[ndarray, "4"]:
    """The weighted least-squares plane; the sign of its normal is arbitrary."""
    centre = np.average(points_world, axis=0, weights=weights)
    offset = points_world - centre
    # The eigenvector of the 3x3 scatter matrix; an SVD of the points would need memory in proportion to them.
    normal = np.linalg.eigh((offset * weights[:, None]).T @ offset)[1][:, 0]
    return np.append(normal, -normal @ centre)


def hypotheses(
    points_world: Float[ndarray, "n 3"],
    normals: Float[ndarray, "n 3"],
    up: Float[ndarray, "3"] | None,
    rng: np.random.Generator,
) -> Float[ndarray, "k 4"]:
    """Planes through random triples of points whose normals agree with the plane's; at most `N_SCORED`."""
    triples = rng.integers(len(points_world), size=(N_HYPOTHESES, 3))
    a, b, c = (points_world[triples[:, i]] for i in range(3))
    normal = np.cross(b - a, c - a)
    length = np.linalg.norm(normal, axis=1)
    facing = normals[triples].sum(axis=1)
    normal *= (np.sign(np.einsum("ij,ij->i", normal, facing)) / np.maximum(length, 1e-12))[:, None]
    agree = np.einsum("kij,kj->ki", normals[triples], normal).min(axis=1) > SAME_FACING
    if up is not None:
        agree &= normal @ up > SAME_FACING
    keep = np.flatnonzero(agree & (length > 1e-9))[:N_SCORED]
    return np.concatenate([normal[keep], -np.einsum("ij,ij->i", normal[keep], a[keep])[:, None]], axis=1)


def support_of(
    planes: Float[ndarray, "k 4"], points_world: Float[ndarray, "n 3"], normals: Float[ndarray, "n 3"], inlier: float
) -> Float[ndarray, "k"]:
    """Share of the points that are inliers of each plane."""
    share = np.empty(len(planes))
    for start in range(0, len(planes), CHUNK):
        chunk = planes[start : start + CHUNK]
        near = np.abs(points_world @ chunk[:, :3].T + chunk[:, 3]) < inlier
        share[start : start + CHUNK] = (near & (normals @ chunk[:, :3].T > SAME_FACING)).mean(axis=0)
    return share


def on_plane(
    points_world: Float[ndarray, "n 3"], normals: Float[ndarray, "n 3"], plane: Float[ndarray, "4"], inlier: float
) -> Bool[ndarray, "n"]:
    """The inliers of a plane: points within `inlier` metres whose normals agree with its own."""
    return (np.abs(height(points_world, plane)) < inlier) & (normals @ plane[:3] > SAME_FACING)


def refine(
    plane: Float[ndarray, "4"],
    points_world: Float[ndarray, "n 3"],
    normals: Float[ndarray, "n 3"],
    areas: Float[ndarray, "n"],
    inlier: float,
) -> Plane:
    """The plane fitted to the surface near it, with that surface's noise and area."""
    tolerance = inlier
    for _ in range(10):
        near = on_plane(points_world, normals, plane, tolerance)
        if near.sum() < 3:
            break
        fitted = fit_plane(points_world[near], areas[near])
        plane = fitted * np.sign(fitted[:3] @ plane[:3])
        residual = height(points_world[near], plane)
        noise = SIGMA_FROM_MAD * float(np.median(np.abs(residual - np.median(residual))))
        # Three sigma keeps the surface and drops the feet of objects on it, which would tilt the fit. Narrowed step by
        # step, because the feet widen the first estimates of the noise.
        tolerance = max(min(0.7 * tolerance, 3 * noise), 2.5 * noise, 1e-4)
    near = on_plane(points_world, normals, plane, inlier)
    residual = height(points_world[near], plane)
    noise = SIGMA_FROM_MAD * float(np.median(np.abs(residual))) if near.any() else 0.0
    return Plane(plane, noise, float(areas[near].sum()))


def upward(world_from_cameras: Float[ndarray, "t 4 4"]) -> Float[ndarray, "3"]:
    """A guess of the support's normal: up in the images, and half as much towards the cameras.

    Level cameras see a wall and a floor, which up in the image distinguishes. Cameras that look straight down see the
    support alone, facing them. The guess is wrong for a camera mounted upside down, so it is only a preference.
    """
    up = -world_from_cameras[:, :3, 1].mean(axis=0) - 0.5 * world_from_cameras[:, :3, 2].mean(axis=0)
    return up / max(float(np.linalg.norm(up)), 1e-12)


def find_planes(
    points_world: Float[ndarray, "n 3"],
    normals: Float[ndarray, "n 3"],
    areas: Float[ndarray, "n"],
    rng: np.random.Generator,
    search: PlaneSearch = PlaneSearch(),
) -> list[Plane]:
    """The largest planes of a surface by RANSAC, the most likely support first; empty when there are none.

    Args:
        normals: unit, towards where the surface was seen from; zero for a point without a surface, which is then no
            inlier.
        areas: square metres of surface that each point represents.

    Raises:
        ValueError: `search.inlier` is not positive.
    """
    inlier = search.inlier
    if inlier <= 0:
        raise ValueError(f"inlier must be > 0 metres, got {inlier}")
    if not areas.sum() > 0:
        return []
    sample = rng.choice(len(points_world), size=min(len(points_world), N_SCORING_POINTS), p=areas / areas.sum())
    points, facing = points_world[sample].astype(np.float64), normals[sample].astype(np.float64)
    free = np.ones(len(sample), bool)
    found: list[Plane] = []
    while len(found) < search.n_planes and free.sum() >= 3:
        candidates = hypotheses(points[free], facing[free], search.up, rng)
        if not len(candidates):
            break
        share = support_of(candidates, points[free], facing[free], inlier)
        plane = refine(candidates[share.argmax()], points_world, normals, areas, inlier)
        if plane.area < search.min_share * areas.sum():
            break
        taken = on_plane(points, facing, plane.plane, 2 * inlier)
        if not (taken & free).any():
            break
        free &= ~taken
        found.append(plane)
    return sorted(found, key=lambda plane: -preference(plane, search.guess_up))


def preference(plane: Plane, guess_up: Float[ndarray, "3"] | None) -> float:
    """Area, square metres, times the cosine to the guessed up; never less than `UNLIKELY` times, as guesses err."""
    return plane.area * (1.0 if guess_up is None else max(float(plane.plane[:3] @ guess_up), UNLIKELY))


def plane_axes(plane: Float[ndarray, "4"]) -> Float[ndarray, "2 3"]:
    """Two perpendicular unit vectors that span the plane."""
    normal = plane[:3]
    first = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(normal, first)])


def largest_patch(xy: Float[ndarray, "n 2"], weights: Float[ndarray, "n"]) -> Bool[ndarray, "n"]:
    """Points of the heaviest connected part, so that a shelf at the same height does not extend the table."""
    cells = np.floor((xy - xy.min(axis=0)) / PATCH_CELL).astype(np.int64)
    grid = np.zeros(cells.max(axis=0) + 1, bool)
    grid[cells[:, 0], cells[:, 1]] = True
    parts = label(grid, structure=np.ones((3, 3)))[0][cells[:, 0], cells[:, 1]]
    return parts == np.bincount(parts, weights=weights).argmax()


def above_footprint(
    points_world: Float[ndarray, "n 3"],
    plane: Float[ndarray, "4"],
    surface_world: Float[ndarray, "m 3"],
    areas: Float[ndarray, "m"],
    margin: float = 0.0,
) -> Bool[ndarray, "n"]:
    """Points above the convex hull of the support's surface: the prism in which objects can stand on it.

    The hull, not the surface itself, because the surface is hidden under the objects and behind them.

    Args:
        surface_world: points on the plane.
        margin: metres by which the hull is widened; negative narrows it.
    """
    axes = plane_axes(plane)
    xy = surface_world @ axes.T
    if len(xy) < 3:
        return np.zeros(len(points_world), bool)
    try:
        hull = ConvexHull(xy[largest_patch(xy, areas)])
    except QhullError:  # All in one line: no footprint, so nothing stands on it.
        return np.zeros(len(points_world), bool)
    inside = np.ones(len(points_world), bool)
    at = points_world @ axes.T
    # One facet at a time, to save memory of the size points x facets.
    for facet in hull.equations:
        inside &= at @ facet[:2] + facet[2] <= margin
    return inside
