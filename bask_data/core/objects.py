"""Splitting of a reconstructed surface into the objects on a support and the background."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from bask_data.core.background import Background, BackgroundSettings, MeshVertices, find_background
from bask_data.core.clusters import dbscan
from bask_data.core.creases import concave_share, with_divided
from bask_data.core.hidden_parts import PartsSettings, with_joined_parts
from bask_data.core.object_doubts import Doubt, SeenScene, doubts_of, seen_share
from bask_data.core.planes import height
from bask_data.core.sightings import fitting

MAX_INSTANCES = 255
"""Label images are bytes, and 0 is the background."""
CORE_SHARE = 0.2
"""Default area of a core, as a share of a disc of radius eps: an edge or a pen has it, scattered specks do not. Chosen,
sensitivity not measured."""
FOOT_FACING = np.cos(np.deg2rad(60.0))
"""Cosine of the angle to the support above which surface is the side of an object, however low. Fusion rounds the
corner between the two; on analytic scenes masks were best at 60 degrees (mean and worst IoU 0.986 and 0.970 at 40,
0.987 and 0.977 at 60, 0.981 and 0.955 at 75)."""
RIM_WIDTH = 0.03
"""Metres along the border of the seen support in which a low, level patch is the support's own. Assumes a tabletop.
Chosen, sensitivity not measured."""
LEVEL_PATCH = np.cos(np.deg2rad(45.0))
"""Cosine of the angle to the support up to which surface may be the support's own. Chosen, sensitivity not measured."""
OFF_SHARE = 0.1
"""Share of a patch that may be higher or steeper than the support's noise. Chosen, sensitivity not measured."""
SEEN_REACH = 0.01
"""Metres beside a line of sight within which surface is met. Chosen, sensitivity not measured."""
FLOATING = 0.03
"""Metres between the support and the lowest object beyond which the support is doubted. Assumes a tabletop. Chosen,
sensitivity not measured."""


@dataclass(frozen=True)
class Instance:
    """One object.

    Args:
        area: square metres of surface.
        centroid: centre of the surface, metres, world.
        extents: edges of its box along the world's axes, metres.
        concave_share: share of its surface that is more than `creases.HOLLOW` inside its convex hull.
        seen: share of its closed surface, without the underside, that was seen.
        doubts: why it may not be an object on the support.
    """

    id: int
    n_vertices: int
    area: float
    centroid: tuple[float, float, float]
    extents: tuple[float, float, float]
    concave_share: float
    seen: float
    doubts: tuple[Doubt, ...] = ()


@dataclass(frozen=True)
class Neighbours:
    """Two objects that nearly touch.

    Args:
        gap: metres between their surfaces.
    """

    a: int
    b: int
    gap: float


@dataclass(frozen=True)
class Split:
    """A surface split into objects.

    Args:
        vertex_instance: 0 background, 1..k the instances, largest surface first.
        background: the planes and the rest of the background.
        neighbours: pairs of objects that would be one with twice the gap allowed.
        n_too_small, n_too_large, n_too_many: numbers of clusters that became background, by reason.
        warnings: for the user, one sentence each.
    """

    vertex_instance: Int[ndarray, "n"]
    instances: tuple[Instance, ...]
    background: Background
    neighbours: tuple[Neighbours, ...] = ()
    n_too_small: int = 0
    n_too_large: int = 0
    n_too_many: int = 0
    warnings: tuple[str, ...] = ()


def vertex_normals_and_areas(
    vertices: Float[ndarray, "n 3"], triangles: Int[ndarray, "m 3"]
) -> tuple[Float[ndarray, "n 3"], Float[ndarray, "n"]]:
    """Unit normals, and the square metres that each vertex represents; both zero for a vertex of no triangle.

    Normals point to the side from which a triangle's corners run counter-clockwise: with fusion, towards the cameras.
    """
    corners = vertices[triangles].astype(np.float64)
    doubled = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    third = np.repeat(np.linalg.norm(doubled, axis=1) / 6.0, 3)
    flat = triangles.ravel()
    # Without triangles, bincount returns integers.
    areas = np.bincount(flat, weights=third, minlength=len(vertices)).astype(np.float64)
    normals = np.stack(
        [np.bincount(flat, weights=np.repeat(axis, 3), minlength=len(vertices)) for axis in doubled.T], axis=1
    ).astype(np.float64)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.divide(normals, length, out=np.zeros_like(normals), where=length > 0), areas


def edges_of(triangles: Int[ndarray, "m 3"]) -> Int[ndarray, "e 2"]:
    """The edges of all triangles; shared edges appear twice."""
    return np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])


@dataclass(frozen=True)
class SplitSettings(BackgroundSettings):
    """Settings of objects and background. The default lengths assume a tabletop.

    Args:
        eps: greatest gap within one object, metres. Its sensitivity is in docs/benchmarks.md.
        core_area: square metres within `eps` that make a core; by default a fifth of a disc of that radius.
        min_area: least surface of an object, square metres.
        bounds: lowest and highest corner of the workspace, metres, world; None if unknown.
        divide: divide clusters that are hollow, or several objects, where their surface is creased inwards.
    """

    eps: float = 0.02
    core_area: float | None = None
    min_area: float = 0.001
    bounds: Float[ndarray, "2 3"] | None = None
    divide: bool = False


def split_objects(
    vertices: Float[ndarray, "n 3"],
    triangles: Int[ndarray, "m 3"],
    rng: np.random.Generator,
    settings: SplitSettings,
) -> Split:
    """The objects on the support of a reconstructed surface.

    Args:
        vertices: metres, world.
        triangles: corners counter-clockwise as seen by the cameras.

    Raises:
        ValueError: a size that must be positive is not, or the plane has no normal.
    """
    eps, min_area = settings.eps, settings.min_area
    if settings.voxel_size <= 0 or eps <= 0:
        raise ValueError(f"voxel_size and eps must be > 0 metres, got {settings.voxel_size} and {eps}")
    settings = replace(settings, views=fitting(settings.views, vertices))
    normals, areas = vertex_normals_and_areas(vertices, triangles)
    scene = find_background(MeshVertices(vertices, normals, areas), rng, settings)
    core = CORE_SHARE * np.pi * eps**2 if settings.core_area is None else settings.core_area
    labels, dropped = clustered(vertices, areas, scene.foreground, eps, core, min_area, settings.max_extent)
    warnings = list(scene.warnings)
    if scene.support is not None:
        edges, heights = edges_of(triangles), height(vertices, scene.support.plane)
        steep = normals @ scene.support.plane[:3] < FOOT_FACING
        labels = with_feet(labels, edges, steep & scene.feet)
        labels = without_rim_patches(labels, heights, normals @ scene.support.plane[:3], scene, settings.inlier)
        n_clusters = len(np.unique(labels[labels > 0]))
        if settings.divide:
            labels = with_divided(labels, MeshVertices(vertices, normals, areas), edges, min_area, MAX_INSTANCES)
        n_divided = len(np.unique(labels[labels > 0])) - n_clusters
        if n_divided:
            warnings.append(
                f"clusters were divided at creases into {n_divided} more objects: --touching one keeps them"
            )
        labels = with_joined_parts(
            labels,
            vertices,
            normals,
            settings.views,
            scene.support.plane[:3],
            PartsSettings(2 * eps, settings.max_extent),
        )
        labels = without_crumbs(labels, edges, heights, areas, max(settings.inlier, 2 * scene.low), min_area)
        lowest = heights[labels > 0].min(initial=np.inf)
        if np.isfinite(lowest) and settings.above is None and lowest > FLOATING:
            warnings.append(
                f"nothing stands on the support found: the lowest object begins {100 * lowest:.0f} cm above it; give "
                "`plane` or `up`"
            )
    labels, n_instances = numbered(labels, vertices, areas)
    return Split(
        labels,
        tuple(
            describe(
                labels,
                n_instances,
                MeshVertices(vertices, normals, areas),
                SeenScene(scene, settings.voxel_size, settings.views, settings.bounds, settings.support == "none"),
                rng,
            )
        ),
        scene,
        neighbours(labels, n_instances, vertices, 2 * eps),
        *dropped,
        tuple(warnings),
    )


def clustered(
    vertices: Float[ndarray, "n 3"],
    areas: Float[ndarray, "n"],
    foreground: Bool[ndarray, "n"],
    eps: float,
    core_area: float,
    min_area: float,
    max_extent: float,
) -> tuple[Int[ndarray, "n"], tuple[int, int, int]]:
    """Cluster of each vertex, from 1, 0 for none; and the numbers of clusters that are too small, too large, and beyond
    the greatest number of instances."""
    labels = np.zeros(len(vertices), np.int64)
    chosen = np.flatnonzero(foreground)
    if not len(chosen):
        return labels, (0, 0, 0)
    points = vertices[chosen].astype(np.float64)
    cluster = dbscan(points, areas[chosen], eps, core_area)
    n_clusters = int(cluster.max()) + 1
    size = np.bincount(cluster + 1, weights=areas[chosen], minlength=n_clusters + 1)[1:]
    extent = np.array([np.ptp(points[cluster == one], axis=0).max() for one in range(n_clusters)])
    small, large = size < min_area, extent > max_extent
    keep = np.flatnonzero(~small & ~large)
    keep = keep[np.argsort(-size[keep], kind="stable")]
    renumber = np.zeros(n_clusters + 1, np.int64)
    renumber[keep[:MAX_INSTANCES] + 1] = np.arange(1, min(len(keep), MAX_INSTANCES) + 1)
    labels[chosen] = renumber[cluster + 1]
    return labels, (int(small.sum()), int((large & ~small).sum()), max(0, len(keep) - MAX_INSTANCES))


def with_feet(labels: Int[ndarray, "n"], edges: Int[ndarray, "e 2"], feet: Bool[ndarray, "n"]) -> Int[ndarray, "n"]:
    """Labels spread along the mesh into the vertices of `feet` that have none."""
    labels = labels.copy()
    both = np.concatenate([edges, edges[:, ::-1]])
    both = both[feet[both[:, 1]] & (labels[both[:, 1]] == 0)]
    while True:
        reach = both[(labels[both[:, 0]] > 0) & (labels[both[:, 1]] == 0)]
        if not len(reach):
            return labels
        # The largest label wins where two meet, so that the order of the triangles does not matter.
        spread = np.zeros_like(labels)
        np.maximum.at(spread, reach[:, 1], labels[reach[:, 0]])
        labels = np.where(labels == 0, spread, labels)


def without_crumbs(
    labels: Int[ndarray, "n"],
    edges: Int[ndarray, "e 2"],
    above: Float[ndarray, "n"],
    areas: Float[ndarray, "n"],
    low: float,
    min_area: float,
) -> Int[ndarray, "n"]:
    """Labels without low patches that the mesh does not connect to their object: bumps of the table near its foot.

    Args:
        above: height above the support, metres.
        low: metres; patches that rise higher belong to the object even if not connected.
        min_area: square metres; patches at least as large belong to it, however low.
    """
    same = edges[(labels[edges[:, 0]] > 0) & (labels[edges[:, 0]] == labels[edges[:, 1]])]
    graph = coo_array((np.ones(len(same), bool), (same[:, 0], same[:, 1])), shape=(len(labels), len(labels)))
    n_patches, patch = connected_components(graph, directed=False)
    top = np.full(n_patches, -np.inf)
    np.maximum.at(top, patch, above)
    area = np.bincount(patch, weights=areas, minlength=n_patches)
    return np.where(((top < low) & (area < min_area))[patch], 0, labels)


def without_rim_patches(
    labels: Int[ndarray, "n"],
    heights: Float[ndarray, "n"],
    facing: Float[ndarray, "n"],
    scene: Background,
    inlier: float,
) -> Int[ndarray, "n"]:
    """Labels without patches of the support itself: along the border of what was seen of it, where depth is worst, and
    level surface within its tolerance only.

    Args:
        heights: metres above the support.
        facing: cosine of the angle between each normal and the support's.
    """
    if scene.outside is None:
        return labels
    off_support = (heights > inlier) | (facing < LEVEL_PATCH) | (scene.outside < -RIM_WIDTH)
    n = np.bincount(labels)
    share = np.bincount(labels, weights=off_support) / np.maximum(n, 1)
    return np.where((share < OFF_SHARE)[labels], 0, labels)


def numbered(
    labels: Int[ndarray, "n"], vertices: Float[ndarray, "n 3"], areas: Float[ndarray, "n"]
) -> tuple[Int[ndarray, "n"], int]:
    """Labels renumbered 1..k by surface area, largest first, and k. Equal areas go by the centroid's x, y, z."""
    present = np.unique(labels[labels > 0])
    weight = np.bincount(labels, weights=areas, minlength=int(labels.max(initial=0)) + 1)
    centroid = [np.bincount(labels, weights=areas * axis, minlength=len(weight))[present] for axis in vertices.T]
    size = weight[present]
    # Rounded, so that the order does not depend on the last bits of a sum.
    keys = [np.round(axis / np.maximum(size, 1e-12), 6) for axis in reversed(centroid)]
    order = present[np.lexsort((*keys, -np.round(size, 9)))]
    renumber = np.zeros(len(weight), np.int32)
    renumber[order] = np.arange(1, len(order) + 1)
    return renumber[labels], len(order)


def describe(
    labels: Int[ndarray, "n"], n_instances: int, surface: MeshVertices, scene: SeenScene, rng: np.random.Generator
) -> list[Instance]:
    """The description of each instance, in order."""
    plane = scene.background.support.plane if scene.background.support else None
    rows = []
    for instance in range(1, n_instances + 1):
        own = surface[labels == instance]
        x, y, z = np.average(own.points, axis=0, weights=own.areas).tolist()
        dx, dy, dz = np.ptp(own.points, axis=0).tolist()
        rows.append(
            Instance(
                instance,
                len(own.points),
                float(own.areas.sum()),
                (x, y, z),
                (dx, dy, dz),
                concave_share(own.points.astype(np.float64), own.areas),
                seen_share(own.points, own.normals, plane, max(SEEN_REACH, 2 * scene.voxel_size), rng),
                doubts_of(own.points, own.normals, scene, surface.points[(labels > 0) & (labels != instance)]),
            )
        )
    return rows


def neighbours(
    labels: Int[ndarray, "n"], n_instances: int, vertices: Float[ndarray, "n 3"], reach: float
) -> tuple[Neighbours, ...]:
    """Pairs of instances whose surfaces come within `reach` metres of each other."""
    points = [vertices[labels == instance] for instance in range(1, n_instances + 1)]
    trees = [cKDTree(own) for own in points]
    pairs = []
    for a in range(n_instances):
        for b in range(a + 1, n_instances):
            if (np.maximum(trees[a].mins - trees[b].maxes, trees[b].mins - trees[a].maxes) > reach).any():
                continue
            # Only points near the other's box need a search.
            near = ((points[a] >= trees[b].mins - reach) & (points[a] <= trees[b].maxes + reach)).all(axis=1)
            gap = trees[b].query(points[a][near], distance_upper_bound=reach)[0].min(initial=np.inf)
            if np.isfinite(gap):
                pairs.append(Neighbours(a + 1, b + 1, float(gap)))
    return tuple(pairs)
