"""The background: the support, the walls of a bin or a shelf, and everything beside or below them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from bask_data.core.footprint import footprint
from bask_data.core.planes import (
    Plane,
    PlaneSearch,
    above_footprint,
    find_planes,
    height,
    largest_patch,
    on_plane,
    plane_axes,
    preference,
    refine,
)
from bask_data.core.sightings import PosedDepth

Support = Literal["planes", "plane", "none"]
"""The support and walls are background, the support alone is, or nothing is."""
RIVAL_SHARE = 0.5
"""A second plane with this share of the support's preference is reported: the choice was close. Chosen, sensitivity not
measured."""
PLANE_NOISE_SIGMAS = 4.0
"""Standard deviations of a plane's noise above which surface is not the plane's. Chosen, sensitivity not measured."""
NOISIEST = 2.5
"""Greatest thickness of a support, in tolerances of the plane search. What is lower than the noise of a bad sensor
cannot be distinguished from it; the feet of higher objects are recovered by their slope. Chosen, sensitivity not
measured."""
LOWEST_STEP = 3.0
"""Least height of a step above the support, in tolerances of the plane search; below, it may be the support's noise.
Chosen, sensitivity not measured."""
MAX_HEIGHT = 1.0
"""Metres above the support beyond which nothing is an object, by default. Assumes a tabletop."""
HIGHEST_FOOT = 0.03
"""Metres above the support beyond which a foot is not recovered, however steep. Assumes a tabletop. Chosen, sensitivity
not measured."""
FACES_UP = 0.5
"""Cosine between a support's normal and the guessed up below which it may be a wall. Chosen: `upward` of level cameras
has a cosine of 0.45 with the normal of a wall that faces them."""
SMALLEST_SUPPORT = 0.15
"""Metres across; a smaller plane is more likely the face of an object. Assumes a tabletop. Chosen, sensitivity not
measured."""
BELOW_SHARE = 0.5
"""Area of the surface below a plane, over the plane's own, from which it is doubted as support: it may be the top of an
object, whose sides are below. Chosen, sensitivity not measured."""
WALL_SHARE = 0.6
"""Least share of the scene's length that a wall runs along; a book that leans on one in a small bin reaches half.
Chosen, sensitivity not measured."""
BEHIND_SHARE = 0.05
"""Largest share of the scene's surface behind a wall: a box has its top and the table behind its front. Chosen,
sensitivity not measured."""
UPRIGHT = np.sin(np.deg2rad(15.0))
"""Sine of the angle by which a wall may lean; a book that leans on one does more. Chosen, sensitivity not measured."""
LEVEL = np.cos(np.deg2rad(15.0))
"""Cosine of the angle by which steps and shelves may be tilted against the support. Upright planes must be walls to be
structure, however long: without its long sides, a crate would fall apart. Chosen, sensitivity not measured."""
N_STRUCTURES = 6
"""Most planes considered as walls and shelves: four sides of a bin and two shelves. Chosen, sensitivity not
measured."""
STRUCTURE_SHARE = 0.05
"""Least share of the surface above the support that a wall holds. Chosen, sensitivity not measured."""

BESIDE = 0.3
"""Metres around the seen support within which surface counts as standing beside it. Assumes a tabletop. Chosen,
sensitivity not measured."""


@dataclass(frozen=True)
class Background:
    """A scene divided into foreground and background.

    Args:
        foreground: vertices that may belong to an object.
        feet: vertices just above the support that may be the foot of one.
        support: None without one.
        structure: walls, and level planes too long for an object.
        low: height above the support, metres, from which surface is foreground.
        outside: metres by which vertices lie beyond the part of the support that was seen, negative above it; None
            without a support.
        warnings: for the user, one sentence each.
    """

    foreground: Bool[ndarray, "n"]
    feet: Bool[ndarray, "n"]
    support: Plane | None = None
    structure: tuple[Plane, ...] = ()
    low: float = 0.0
    outside: Float[ndarray, "n"] | None = None
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class MeshVertices:
    """The vertices of a mesh.

    Args:
        points: metres, world.
        normals: unit, towards where the surface was seen from; zero for a vertex of no triangle.
        areas: square metres of surface that each vertex represents.
    """

    points: Float[ndarray, "n 3"]
    normals: Float[ndarray, "n 3"]
    areas: Float[ndarray, "n"]

    def __getitem__(self, chosen: Bool[ndarray, "n"]) -> MeshVertices:
        return MeshVertices(self.points[chosen], self.normals[chosen], self.areas[chosen])


@dataclass(frozen=True)
class BackgroundSettings:
    """Settings of the background.

    Args:
        voxel_size: metres; finer structure is not resolved.
        support: what is background: the support and walls, the support alone, or nothing.
        plane: the support; None to find it.
        up: unit vector that the support faces, within 30 degrees; None for any.
        guess_up: unit vector; planes that face it are preferred.
        inlier: metres from a plane within which points support it in the search. Its sensitivity is in
            docs/benchmarks.md.
        above: heights above the support, metres, between which surface belongs to objects; by default from a voxel or
            the noise to 1 m.
        margin: metres by which an object may project beyond the seen support.
        max_extent: greatest length of an object, metres; the default assumes a tabletop.
        views: some frames, to tell what is hidden from what is empty.
    """

    voxel_size: float
    support: Support = "planes"
    plane: Float[ndarray, "4"] | None = None
    up: Float[ndarray, "3"] | None = None
    guess_up: Float[ndarray, "3"] | None = None
    inlier: float = 0.01
    above: tuple[float, float] | None = None
    margin: float = 0.0
    max_extent: float = 0.6
    views: tuple[PosedDepth, ...] = ()


def find_background(
    surface: MeshVertices,
    rng: np.random.Generator,
    settings: BackgroundSettings,
) -> Background:
    """Divide a scene into background and what may be objects.

    Raises:
        ValueError: the plane's normal is zero, or `inlier` is not positive.
    """
    plane, inlier, voxel_size = settings.plane, settings.inlier, settings.voxel_size
    real = surface.areas > 0
    if settings.support == "none":
        return Background(real, np.zeros(len(real), bool))
    if plane is None:
        found, warnings = support_of_scene(surface, rng, settings.up, settings.guess_up, inlier)
    else:
        found, warnings = given_support(plane, surface, inlier), ()
    if found is None:
        return Background(np.zeros(len(real), bool), np.zeros(len(real), bool), warnings=warnings)
    cut = thickness(found, voxel_size, NOISIEST * inlier)
    low, high = (cut, MAX_HEIGHT) if settings.above is None else settings.above
    heights = height(surface.points, found.plane)
    over = real & (heights > 0) & (heights < high)
    floor = on_plane(surface.points, surface.normals, found.plane, max(inlier, cut)) & real
    # Walls stand on the rim of the floor: half of their surface is beside it.
    beside = over.copy()
    ground = footprint(found.plane, surface.points[floor], surface.areas[floor], settings.views)
    outside = ground.outside(surface.points)
    if plane is None:
        beside &= outside <= settings.margin + 2 * inlier
        over &= outside <= settings.margin
        raised = real & (heights > low) & (heights < high)
        warnings += _beside_the_support(surface.areas, raised, over, outside, settings.margin)
    structure: list[Plane] = []
    if settings.support == "planes":
        for wall, is_wall in walls(
            surface, beside & (heights > low), floor, found.plane, rng, inlier, settings.max_extent
        ):
            apart = height(surface.points, wall.plane)
            # No more than the tolerance here: what leans on a wall would go with it.
            depth = thickness(wall, voxel_size, inlier)
            over &= ~on_plane(surface.points, surface.normals, wall.plane, depth)
            if is_wall:
                over &= apart > -depth
            structure.append(wall)
    feet = over & (heights <= min(low, HIGHEST_FOOT))
    return Background(over & (heights > low), feet, found, tuple(structure), low, outside, warnings)


def _beside_the_support(
    areas: Float[ndarray, "n"],
    raised: Bool[ndarray, "n"],
    over: Bool[ndarray, "n"],
    outside: Float[ndarray, "n"],
    margin: float,
) -> tuple[str, ...]:
    """A warning if more surface stands beside the part of the support that was seen than above it.

    Args:
        raised: surface at the heights of objects.
        over: surface above the footprint of the support.
        outside: metres beyond that footprint.
    """
    near = raised & ~over & (outside <= margin + BESIDE)
    beside, above = float(areas[near].sum()), float(areas[raised & over].sum())
    if not 0 < above < beside:
        return ()
    return (
        f"{beside:.2g} m2 of surface stand beside the part of the support that was seen, {above:.2g} m2 above it: "
        f"where objects hide the support's border, pass --margin {BESIDE:g}",
    )


def thickness(plane: Plane, voxel_size: float, most: float) -> float:
    """Metres from a plane within which surface belongs to it: a voxel, or its noise up to `most`."""
    return max(voxel_size, min(PLANE_NOISE_SIGMAS * plane.noise, most))


def given_support(plane: Float[ndarray, "4"], surface: MeshVertices, inlier: float) -> Plane:
    """A given plane, unchanged, with the noise of the surface near it.

    Raises:
        ValueError: the normal is zero.
    """
    length = np.linalg.norm(plane[:3])
    if not length > 0:
        raise ValueError(f"the plane's normal must not be zero, got {plane.tolist()}")
    refined = refine(plane / length, surface.points, surface.normals, surface.areas, inlier)
    return Plane(plane / length, refined.noise, refined.area)


def support_of_scene(
    surface: MeshVertices,
    rng: np.random.Generator,
    up: Float[ndarray, "3"] | None,
    guess_up: Float[ndarray, "3"] | None,
    inlier: float,
) -> tuple[Plane | None, tuple[str, ...]]:
    """The most likely plane without a reason for doubt, else the most likely one; and warnings, with the reason."""
    planes = find_planes(surface.points, surface.normals, surface.areas, rng, PlaneSearch(inlier, up, guess_up))
    if not planes:
        return None, ("no support plane was found, so nothing can be told from the background",)
    doubts = [doubt(plane, surface, inlier) for plane in planes]
    best = next((i for i, reason in enumerate(doubts) if not reason), 0)
    rivals = [
        plane
        for i, plane in enumerate(planes)
        if i != best
        and not doubts[i]
        and preference(plane, guess_up) > RIVAL_SHARE * preference(planes[best], guess_up)
        and is_another(plane, planes[best], surface, inlier)
    ]
    warnings = [
        f"a second plane, {rounded(plane)}, holds {plane.area:.3f} m2 beside the support's "
        f"{planes[best].area:.3f} m2: if the objects stand on that one, give `plane` or `up`"
        for plane in rivals
    ]
    if up is None and guess_up is not None and planes[best].plane[:3] @ guess_up < FACES_UP:
        warnings.append(
            f"the support found, {rounded(planes[best])}, faces the cameras more than up: right if they look down, a "
            "wall if they look level; then give `plane` or `up`"
        )
    return planes[best], tuple([doubts[best]] if doubts[best] else []) + tuple(warnings)


def is_another(plane: Plane, best: Plane, surface: MeshVertices, inlier: float) -> bool:
    """Whether most of a plane's surface is off another plane. The noise of a large table supports tilted planes."""
    own = on_plane(surface.points, surface.normals, plane.plane, inlier)
    off = np.abs(height(surface.points[own], best.plane)) > 2 * inlier
    return bool(surface.areas[own][off].sum() > 0.5 * surface.areas[own].sum())


def doubt(plane: Plane, surface: MeshVertices, inlier: float) -> str:
    """The reason to doubt that a plane is the support, as a sentence; empty without one."""
    floor = on_plane(surface.points, surface.normals, plane.plane, inlier) & (surface.areas > 0)
    if floor.sum() < 3:
        return "the support found has no surface: give `plane` or `up`"
    points, areas = surface.points[floor], surface.areas[floor]
    patch = largest_patch(points @ plane_axes(plane.plane).T, areas)
    length = longest(points[patch])
    if length < SMALLEST_SUPPORT:
        return (
            f"the support found is only {100 * length:.0f} cm long: it may be the face of an object; give `plane` or "
            "`up`, or a larger workspace"
        )
    below = (height(surface.points, plane.plane) < -2 * inlier) & (surface.areas > 0)
    # Slightly wider than the plane, because the sides of an object are straight below the rim of its top.
    under = surface.areas[below][above_footprint(surface.points[below], plane.plane, points, areas, 2 * inlier)].sum()
    if under > BELOW_SHARE * areas[patch].sum():
        return (
            f"below the support found, {rounded(plane)}, lie {under:.3f} m2 of surface: it may be "
            "the top of an object or a shelf; give `plane` or `up`"
        )
    return ""


def rounded(plane: Plane) -> list[float]:
    """The plane for a sentence. Adding zero turns -0.0 into 0.0."""
    return (np.round(plane.plane, 3) + 0.0).tolist()


def walls(
    surface: MeshVertices,
    foreground: Bool[ndarray, "n"],
    floor: Bool[ndarray, "n"],
    support: Float[ndarray, "4"],
    rng: np.random.Generator,
    inlier: float,
    max_extent: float,
) -> list[tuple[Plane, bool]]:
    """Planes above the support that are structure rather than faces of objects, and whether each is a wall.

    Structure are level planes longer than any object, such as steps and shelves, and upright planes that run along most
    of the scene with hardly any surface behind: the walls of a bin or a shelf, which may be as small as an object.
    """
    above = surface[foreground]
    scene = surface[foreground | floor]
    found: list[tuple[Plane, bool]] = []
    search = PlaneSearch(inlier, n_planes=N_STRUCTURES, min_share=STRUCTURE_SHARE)
    for plane in find_planes(above.points, above.normals, above.areas, rng, search):
        own = on_plane(above.points, above.normals, plane.plane, inlier)
        patch = above.points[own]
        patch = patch[largest_patch(patch @ plane_axes(plane.plane).T, above.areas[own])]
        is_wall = bounds_scene(plane, patch, scene, support, inlier)
        is_level = abs(plane.plane[:3] @ support[:3]) > LEVEL
        is_level &= float(np.median(height(patch, support))) > LOWEST_STEP * inlier
        if is_wall or (is_level and longest(patch) > max_extent):
            found.append((plane, is_wall))
    return found


def bounds_scene(
    plane: Plane, patch: Float[ndarray, "m 3"], scene: MeshVertices, support: Float[ndarray, "4"], inlier: float
) -> bool:
    """Whether a plane is upright and runs along most of the scene with hardly any surface behind it."""
    if abs(plane.plane[:3] @ support[:3]) > UPRIGHT:
        return False
    along = np.cross(plane.plane[:3], support[:3])
    if spread(patch @ along) < WALL_SHARE * spread(scene.points @ along):
        return False
    # Twice the tolerance: what is just behind may be the other side of the same board.
    behind = scene.areas[height(scene.points, plane.plane) < -2 * inlier].sum()
    return bool(behind < BEHIND_SHARE * scene.areas.sum())


def spread(values: Float[ndarray, "n"]) -> float:
    """Distance from the 1st to the 99th percentile."""
    low, high = np.percentile(values, [1, 99])
    return float(high - low)


def longest(points: Float[ndarray, "n 3"]) -> float:
    """Length along the principal axis, metres."""
    offset = points - points.mean(axis=0)
    axis = np.linalg.eigh(offset.T @ offset)[1][:, -1]
    return spread(offset @ axis)
