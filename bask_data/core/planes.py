"""The support plane: where it is, how noisy it is, and what stands on it.

Planes are (4,) float64 [nx, ny, nz, d] with |n| = 1 and n.x + d = 0; n points to the side the surface was seen from,
where the objects are, so `height` is positive above the support.
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
"""Vertices whose normal is further from the plane's belong to something that cuts through it, not to the plane."""
N_HYPOTHESES = 8192
"""Triples drawn for one plane. With three of ten points on the plane, some two hundred are on it entirely. Sensitivity
not measured."""
N_SCORED = 512
"""Of these, at most, the planes whose support is counted; a bound of time. Sensitivity not measured."""
N_SCORING_POINTS = 20_000
"""Points, drawn by area, on which support is counted: a share of 3 % is then known within 0.12 %. Sensitivity not
measured."""
CHUNK = 64
"""Planes scored at once; a bound of memory, 10 MB a chunk. It changes no result."""
UNLIKELY = 0.1
"""What a plane that turns its back on the guessed up counts for: it must be ten times as large."""
PATCH_CELL = 0.02
"""Parts of a plane further apart than this, metres, are different surfaces that happen to be level."""


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
    """What `find_planes` looks for.

    Args:
        inlier: metres a point may be off a plane to count for it. A depth camera's noise at a metre is 2 to 5 mm.
        up: unit vector; only planes within 30 degrees of facing it are looked for.
        guess_up: unit vector; planes are ordered by area times how much they face it, or by area alone without it.
        n_planes: found at most.
        min_share: of the surface that a plane must hold.
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
    """The weighted least-squares plane; the sign of its normal means nothing."""
    centre = np.average(points_world, axis=0, weights=weights)
    offset = points_world - centre
    # Smallest eigenvector of the scatter matrix; 3x3, whereas an SVD of the points would need memory in proportion to
    # them.
    normal = np.linalg.eigh((offset * weights[:, None]).T @ offset)[1][:, 0]
    return np.append(normal, -normal @ centre)


def hypotheses(
    points_world: Float[ndarray, "n 3"],
    normals: Float[ndarray, "n 3"],
    up: Float[ndarray, "3"] | None,
    rng: np.random.Generator,
) -> Float[ndarray, "k 4"]:
    """Planes through random triples of points that all face the plane's way; at most `N_SCORED`."""
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
    """Share of the points that lie on each plane and face its way."""
    share = np.empty(len(planes))
    for start in range(0, len(planes), CHUNK):
        some = planes[start : start + CHUNK]
        near = np.abs(points_world @ some[:, :3].T + some[:, 3]) < inlier
        share[start : start + CHUNK] = (near & (normals @ some[:, :3].T > SAME_FACING)).mean(axis=0)
    return share


def on_plane(
    points_world: Float[ndarray, "n 3"], normals: Float[ndarray, "n 3"], plane: Float[ndarray, "4"], inlier: float
) -> Bool[ndarray, "n"]:
    """Points within `inlier` metres of the plane that face its way."""
    return (np.abs(height(points_world, plane)) < inlier) & (normals @ plane[:3] > SAME_FACING)


def refine(
    plane: Float[ndarray, "4"],
    points_world: Float[ndarray, "n 3"],
    normals: Float[ndarray, "n 3"],
    areas: Float[ndarray, "n"],
    inlier: float,
) -> Plane:
    """The plane moved to the middle of the surface near it, with that surface's noise."""
    tolerance = inlier
    for _ in range(10):
        near = on_plane(points_world, normals, plane, tolerance)
        if near.sum() < 3:
            break
        fitted = fit_plane(points_world[near], areas[near])
        plane = fitted * np.sign(fitted[:3] @ plane[:3])
        residual = height(points_world[near], plane)
        noise = SIGMA_FROM_MAD * float(np.median(np.abs(residual - np.median(residual))))
        # Three sigma keeps the surface and drops the feet of what stands on it, which would tilt the fit. Narrowed step
        # by step, because the feet widen the first estimates of the noise.
        tolerance = max(min(0.7 * tolerance, 3 * noise), 2.5 * noise, 1e-4)
    near = on_plane(points_world, normals, plane, inlier)
    residual = height(points_world[near], plane)
    noise = SIGMA_FROM_MAD * float(np.median(np.abs(residual))) if near.any() else 0.0
    return Plane(plane, noise, float(areas[near].sum()))


def upward(world_from_cameras: Float[ndarray, "t 4 4"]) -> Float[ndarray, "3"]:
    """A guess at the side a support faces: up in the images, and half as much towards the cameras.

    Level cameras see a wall and a floor; up in the image tells them apart. Cameras that look straight down see the
    support alone, facing them. Wrong for a camera mounted upside down, so it is good for a preference and not for a
    verdict.
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
    """The largest planes of a surface by RANSAC, the likeliest support first; empty when there are none.

    Args:
        normals: unit, towards where the surface was seen from; zero for a point without a surface, which then supports
            nothing.
        areas: square metres each point stands for.

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
    return sorted(found, key=lambda one: -preference(one, search.guess_up))


def preference(plane: Plane, guess_up: Float[ndarray, "3"] | None) -> float:
    """Square metres, counted for less the more the plane turns from the guess; never for nothing, as guesses err."""
    return plane.area * (1.0 if guess_up is None else max(float(plane.plane[:3] @ guess_up), UNLIKELY))


def plane_axes(plane: Float[ndarray, "4"]) -> Float[ndarray, "2 3"]:
    """Two perpendicular unit vectors that span the plane."""
    normal = plane[:3]
    first = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(normal, first)])


def largest_patch(xy: Float[ndarray, "n 2"], weights: Float[ndarray, "n"]) -> Bool[ndarray, "n"]:
    """Points of the heaviest connected part, so that a level shelf elsewhere does not stretch the table."""
    cells = np.floor(xy / PATCH_CELL).astype(np.int64)
    cells -= cells.min(axis=0)
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
    """Points over the convex hull of the support's surface: the prism in which objects can stand on it.

    The hull, not the surface itself, because the surface is unseen under the objects and behind them.

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
    # One facet at a time: all at once would take points x facets of memory.
    for facet in hull.equations:
        inside &= at @ facet[:2] + facet[2] <= margin
    return inside
