"""Objects that touch, divided where the surface is creased inwards."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, QhullError, cKDTree

from bask_data.core.background import MeshVertices

HOLLOW = 0.01
"""Metres inside the convex hull from which surface counts as hollow. Assumes a tabletop. Chosen, sensitivity not
measured."""
CONCAVE_SHARE = 0.25
"""Hollow share of the surface from which an object may be several that touch. On labelled single views of cluttered
tables all seven clusters of two or three objects had 0.32 to 0.65, all thirty of one object 0.05 or less; but a bowl or
a bin is hollow, too."""
N_HULL_POINTS = 2000
"""Most points of an object that its hollow share is computed from. Chosen, sensitivity not measured."""
NORMAL_RADIUS = 0.008
"""Metres over which normals are averaged. Assumes a tabletop and voxels of some 4 mm. Chosen, sensitivity not measured.
"""
CREASE_REACH = 0.012
"""Metres across a crease: fusion rounds it over some voxels. Chosen, sensitivity not measured."""
CREASE = np.cos(np.deg2rad(30.0))
"""Cosine of the angle by which the surface bends inwards over `CREASE_REACH` at a crease. The inside of a cup of 8 cm
bends by 17 degrees. On seven single views 22 degrees found the same objects, and one more piece in three of them."""
CREASED_SHARE = 0.1
"""Least share of the surface around a point that lies beyond a crease for the point to be in it. Chosen, sensitivity
not measured."""


def with_divided(
    labels: Int[ndarray, "n"], surface: MeshVertices, edges: Int[ndarray, "e 2"], min_area: float, most: int
) -> Int[ndarray, "n"]:
    """Labels in which clusters that may be several objects are divided at creases, up to label `most`."""
    result = labels.copy()
    for cluster in np.unique(labels[labels > 0]):
        mine = np.flatnonzero(labels == cluster)
        points = surface.points[mine].astype(np.float64)
        if concave_share(points, surface.areas[mine]) < CONCAVE_SHARE:
            continue
        number = np.full(len(labels), -1)
        number[mine] = np.arange(len(mine))
        own = number[edges]
        own = own[(own >= 0).all(axis=1)]
        piece = divided(points, surface.normals[mine], surface.areas[mine], own, min_area)
        if result.max() + piece.max() <= most:
            result[mine] = np.where(piece == 0, cluster, result.max() + piece)
    return result


def divided(
    points: Float[ndarray, "n 3"],
    normals: Float[ndarray, "n 3"],
    areas: Float[ndarray, "n"],
    edges: Int[ndarray, "e 2"],
    min_area: float,
) -> Int[ndarray, "n"]:
    """Piece of each point of a cluster, from 0: parts of the mesh that creases, or gaps in it, separate.

    Pieces smaller than `min_area` go to the nearest larger one; a handle is not an object.

    Args:
        points: metres.
        normals: unit, towards the cameras.
        edges: of the mesh, as numbers of points.
    """
    creased = in_crease(points, normals)
    kept = edges[~creased[edges].any(axis=1)]
    graph = coo_array((np.ones(len(kept), bool), (kept[:, 0], kept[:, 1])), shape=(len(points), len(points)))
    n_pieces, piece = connected_components(graph, directed=False)
    size = np.bincount(piece, weights=areas * ~creased, minlength=n_pieces)
    large = (size >= min_area)[piece] & ~creased
    if not large.any():
        return np.zeros(len(points), np.int64)
    sure = np.flatnonzero(large)
    nearest = sure[cKDTree(points[sure]).query(points)[1]]
    return np.unique(piece[nearest], return_inverse=True)[1].reshape(-1)


def in_crease(points: Float[ndarray, "n 3"], normals: Float[ndarray, "n 3"]) -> Bool[ndarray, "n"]:
    """Points where the surface bends inwards sharply: there, normals lean towards each other."""
    tree = cKDTree(points)
    smooth = np.array([normals[near].sum(axis=0) for near in tree.query_ball_point(points, NORMAL_RADIUS)])
    smooth /= np.maximum(np.linalg.norm(smooth, axis=1, keepdims=True), 1e-9)
    a, b = tree.query_pairs(CREASE_REACH, output_type="ndarray").T
    inwards = np.einsum("ij,ij->i", points[b] - points[a], smooth[b] - smooth[a]) < 0
    inwards &= np.einsum("ij,ij->i", smooth[a], smooth[b]) < CREASE
    n_around = np.bincount(a, minlength=len(points)) + np.bincount(b, minlength=len(points))
    n_beyond = np.bincount(a[inwards], minlength=len(points)) + np.bincount(b[inwards], minlength=len(points))
    return n_beyond > CREASED_SHARE * n_around


def concave_share(points: Float[ndarray, "n 3"], areas: Float[ndarray, "n"]) -> float:
    """Share of a surface that is more than `HOLLOW` inside its convex hull, from a sample of its points."""
    try:
        facets = ConvexHull(points).equations
    except (QhullError, ValueError):  # Flat, or fewer than four points.
        return 0.0
    sample = slice(None, None, -(-len(points) // N_HULL_POINTS))
    depth = -(points[sample] @ facets[:, :3].T + facets[:, 3]).max(axis=1)
    return float(areas[sample][depth > HOLLOW].sum() / max(areas[sample].sum(), 1e-12))
