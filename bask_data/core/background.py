"""What is not an object: the support, the walls of a bin or a shelf, and all that is beside or below them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

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

Support = Literal["planes", "plane", "none"]
"""The support and walls are background, the support alone is, or nothing is."""
RIVAL_SHARE = 0.5
"""A second plane this large beside the support is worth a word: the choice between them was close."""
PLANE_NOISE_SIGMAS = 4.0
"""Surface further above a plane than this is no noise of the plane."""
NOISIEST = 2.5
"""Times the tolerance of the search that a support may be thick. What is lower than the noise of a bad sensor cannot be
told from it; the feet of what is higher are taken back by their steepness."""
LOWEST_STEP = 3.0
"""Times the tolerance that a step is above the support; below, it is the support's own noise."""
MAX_HEIGHT = 1.0
"""Metres above the support beyond which nothing is an object, unless it was said otherwise."""
HIGHEST_FOOT = 0.03
"""Metres; above this, surface below what was asked for is not taken back, however steep."""
FACES_UP = 0.5
"""Cosine to the guessed up below which a support may be a wall: level cameras guess up at 0.45 from a wall's normal,
and so do cameras that look straight down from a table's."""
SMALLEST_SUPPORT = 0.15
"""Metres across; a plane smaller than this is more likely the face of an object."""
BELOW_SHARE = 0.5
"""A plane is no support when the surface below it measures this share of it: it is the top of an object then, whose
sides are below."""
WALL_SHARE = 0.6
"""A wall runs along this share of the scene at least; a book that leans on one in a small bin reaches half."""
BEHIND_SHARE = 0.05
"""Of the scene's surface, at most, behind a wall. A box has its top and the table behind its front."""
UPRIGHT = np.sin(np.deg2rad(15.0))
"""Walls lean less than this from the support's normal; a book that leans on one does not."""
LEVEL = np.cos(np.deg2rad(15.0))
"""Steps and shelves turn less than this from the support. Upright planes must be walls to be structure, however long:
to take a crate's sides away would leave its ends."""
N_STRUCTURES = 6
"""Planes looked at for walls and shelves: the four sides of a bin, and two shelves. Sensitivity not measured."""
STRUCTURE_SHARE = 0.05
"""Of the surface above the support that a wall holds at least."""


@dataclass(frozen=True)
class Background:
    """A scene parted into what may be objects and what is not.

    Args:
        foreground: what may be an object.
        feet: what is just above the support and may be the foot of one.
        support: None without one.
        structure: walls, and what else is too long for an object.
        low: height above the support, metres, from which surface is foreground.
        warnings: what a user should look at, one sentence each.
    """

    foreground: Bool[ndarray, "n"]
    feet: Bool[ndarray, "n"]
    support: Plane | None = None
    structure: tuple[Plane, ...] = ()
    low: float = 0.0
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class MeshVertices:
    """The vertices of a mesh.

    Args:
        points: metres, world.
        normals: unit, towards where the surface was seen from; zero for a vertex of no triangle.
        areas: square metres each vertex stands for.
    """

    points: Float[ndarray, "n 3"]
    normals: Float[ndarray, "n 3"]
    areas: Float[ndarray, "n"]

    def __getitem__(self, chosen: Bool[ndarray, "n"]) -> MeshVertices:
        return MeshVertices(self.points[chosen], self.normals[chosen], self.areas[chosen])


@dataclass(frozen=True)
class BackgroundSettings:
    """What is background.

    Args:
        voxel_size: metres; what the surface cannot resolve.
        support: what is background: the support and walls, the support alone, or nothing.
        plane: the support; found when not given.
        up: unit vector the support faces, within 30 degrees; any when None.
        guess_up: unit vector; of several planes the one that faces it is preferred.
        inlier: metres off a plane that still count for it when it is looked for.
        above: heights above the support, metres, between which surface belongs to objects; by default from a voxel or
            the noise to 1 m.
        margin: metres an object may stand out over the seen support.
        max_extent: metres an object is long at most.
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


def find_background(
    surface: MeshVertices,
    rng: np.random.Generator,
    settings: BackgroundSettings,
) -> Background:
    """Part a scene into background and what may be objects."""
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
    if plane is None:
        for chosen, wider in ((beside, 2 * inlier), (over, 0.0)):
            chosen[chosen] = above_footprint(
                surface.points[chosen],
                found.plane,
                surface.points[floor],
                surface.areas[floor],
                settings.margin + wider,
            )
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
    return Background(over & (heights > low), feet, found, tuple(structure), low, warnings)


def thickness(plane: Plane, voxel_size: float, most: float) -> float:
    """Metres from a plane within which surface is the plane's: a voxel, or the noise."""
    return max(voxel_size, min(PLANE_NOISE_SIGMAS * plane.noise, most))


def given_support(plane: Float[ndarray, "4"], surface: MeshVertices, inlier: float) -> Plane:
    """The plane where it was put; refined only to learn the surface's noise."""
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
    """The likeliest plane of which nothing speaks against its being the support; without one the likeliest, with what
    speaks against it as warnings."""
    planes = find_planes(surface.points, surface.normals, surface.areas, rng, PlaneSearch(inlier, up, guess_up))
    if not planes:
        return None, ("no support plane was found, so nothing can be told from the background",)
    doubts = [doubt(one, surface, inlier) for one in planes]
    best = next((i for i, one in enumerate(doubts) if not one), 0)
    rivals = [
        one
        for i, one in enumerate(planes)
        if i != best
        and not doubts[i]
        and preference(one, guess_up) > RIVAL_SHARE * preference(planes[best], guess_up)
        and is_another(one, planes[best], surface, inlier)
    ]
    warnings = [
        f"a second plane, {rounded(one)}, holds {one.area:.3f} m2 beside the support's "
        f"{planes[best].area:.3f} m2: if the objects stand on that one, give `plane` or `up`"
        for one in rivals
    ]
    if up is None and guess_up is not None and planes[best].plane[:3] @ guess_up < FACES_UP:
        warnings.append(
            f"the support found, {rounded(planes[best])}, faces the cameras more than up: right if they look down, a "
            "wall if they look level; then give `plane` or `up`"
        )
    return planes[best], tuple([doubts[best]] if doubts[best] else []) + tuple(warnings)


def is_another(plane: Plane, best: Plane, surface: MeshVertices, inlier: float) -> bool:
    """Whether most of a plane's surface is off another's. Noise of a large table holds tilted planes of its own."""
    mine = on_plane(surface.points, surface.normals, plane.plane, inlier)
    off = np.abs(height(surface.points[mine], best.plane)) > 2 * inlier
    return bool(surface.areas[mine][off].sum() > 0.5 * surface.areas[mine].sum())


def doubt(plane: Plane, surface: MeshVertices, inlier: float) -> str:
    """What speaks against a plane's being the support, as a sentence; empty when nothing does."""
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
    # A little wider than the plane, because the sides of an object are straight below the rim of its top.
    under = surface.areas[below][above_footprint(surface.points[below], plane.plane, points, areas, 2 * inlier)].sum()
    if under > BELOW_SHARE * areas[patch].sum():
        return (
            f"below the support found, {rounded(plane)}, lie {under:.3f} m2 of surface: it may be "
            "the top of an object or a shelf; give `plane` or `up`"
        )
    return ""


def rounded(plane: Plane) -> list[float]:
    """The plane for a sentence; adding zero makes -0.0 into 0.0."""
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
    """Planes above the support that are structure and no face of an object, and whether each is a wall.

    Level planes longer than any object may be are: steps and shelves. So is an upright one that runs along most of the
    scene and has next to nothing behind it: the wall of a bin or a shelf, which may be as small as an object.
    """
    above = surface[foreground]
    scene = surface[foreground | floor]
    found: list[tuple[Plane, bool]] = []
    search = PlaneSearch(inlier, n_planes=N_STRUCTURES, min_share=STRUCTURE_SHARE)
    for one in find_planes(above.points, above.normals, above.areas, rng, search):
        mine = on_plane(above.points, above.normals, one.plane, inlier)
        patch = above.points[mine]
        patch = patch[largest_patch(patch @ plane_axes(one.plane).T, above.areas[mine])]
        is_wall = bounds_scene(one, patch, scene, support, inlier)
        is_level = abs(one.plane[:3] @ support[:3]) > LEVEL
        is_level &= float(np.median(height(patch, support))) > LOWEST_STEP * inlier
        if is_wall or (is_level and longest(patch) > max_extent):
            found.append((one, is_wall))
    return found


def bounds_scene(
    plane: Plane, patch: Float[ndarray, "m 3"], scene: MeshVertices, support: Float[ndarray, "4"], inlier: float
) -> bool:
    """Whether an upright plane runs along most of the scene and has next to nothing behind it."""
    if abs(plane.plane[:3] @ support[:3]) > UPRIGHT:
        return False
    along = np.cross(plane.plane[:3], support[:3])
    if spread(patch @ along) < WALL_SHARE * spread(scene.points @ along):
        return False
    # Twice the tolerance: what is just behind may be the other side of the same board.
    behind = scene.areas[height(scene.points, plane.plane) < -2 * inlier].sum()
    return bool(behind < BEHIND_SHARE * scene.areas.sum())


def spread(values: Float[ndarray, "n"]) -> float:
    """Length of all but the outermost hundredths."""
    low, high = np.percentile(values, [1, 99])
    return float(high - low)


def longest(points: Float[ndarray, "n 3"]) -> float:
    """Length along the longest axis, metres."""
    offset = points - points.mean(axis=0)
    axis = np.linalg.eigh(offset.T @ offset)[1][:, -1]
    return spread(offset @ axis)
