"""A frame prepared for matching: its best depth, and the pixels that can be trusted, by object."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, Int32, UInt8
from numba import njit
from numpy import ndarray

from bask_data.core.compiled import compiled
from bask_data.core.correspondences.refinement import refined
from bask_data.core.geometry import unproject
from bask_data.core.visibility.surface import Surface

GRAZING_ANGLE = np.deg2rad(75.0)
"""Angle of incidence, radians, above which surface is not matched: an error along its normal is four times as large
along the ray. Chosen, sensitivity not measured."""

GRAZING = np.cos(GRAZING_ANGLE)
"""The same as a cosine."""

STEEPEST = float(np.tan(GRAZING_ANGLE))
"""Change of depth over lateral distance of a surface seen at that angle."""

ON_SURFACE = 0.005
"""Metres in front of a point within which a hit belongs to the point's own surface; assumes a tabletop. Chosen,
sensitivity not measured."""

EDGE_JUMP = 0.5
"""Share of the tolerance, beyond the slope of one surface, from which a change of depth is an edge. Chosen, sensitivity
not measured."""

N_INSTANCES = 256
"""Number of values of an 8-bit label image, background (0) included."""


@dataclass(frozen=True)
class MatchableView:
    """One frame prepared for matching (`matchable_view`).

    Args:
        depth: best known z-depth, metres; 0 means unknown.
        instance: visible instance at each pixel, 0 none.
        sure: `instance` where it and the depth can be trusted, else 0.
        pixels: flat indices of sure pixels by instance: those of k are `pixels[first[k]:first[k + 1]]`.
        margin: pixels that a match stays away from the edges of masks and of surfaces.
        noise: standard deviation of measured depth, as a share of the tolerance; 0 if unknown.
    """

    depth: Float32[ndarray, "h w"]
    instance: UInt8[ndarray, "h w"]
    sure: UInt8[ndarray, "h w"]
    pixels: Int32[ndarray, "p"]
    first: Int[ndarray, "257"]
    K: Float[ndarray, "3 3"]
    world_from_camera: Float[ndarray, "4 4"]
    margin: int
    noise: float


def cast_through(
    surface: Surface,
    uv: Float[ndarray, "n 2"],
    K: Float[ndarray, "3 3"],
    world_from_camera: Float[ndarray, "4 4"],
) -> tuple[Float32[ndarray, "n"], Float32[ndarray, "n"]]:
    """z-depth of the first hit through each pixel, metres, infinity for none; and the cosine of its angle of
    incidence."""
    directions = (unproject(uv, np.ones(len(uv)), K) @ world_from_camera[:3, :3].T).astype(np.float32)
    rays = np.empty((len(uv), 6), np.float32)
    rays[:, :3], rays[:, 3:] = world_from_camera[:3, 3], directions
    hits = surface.cast(rays)
    cosine = np.abs(np.einsum("ij,ij->i", hits.normal, directions))
    return hits.distance, cosine / np.linalg.norm(directions, axis=1)


def unhidden(
    surface: Surface, points_world: Float[ndarray, "n 3"], world_from_camera: Float[ndarray, "4 4"]
) -> Bool[ndarray, "n"]:
    """Points of a surface with no other part of it between them and the camera."""
    rays = np.empty((len(points_world), 6), np.float32)
    rays[:, :3], rays[:, 3:] = world_from_camera[:3, 3], points_world - world_from_camera[:3, 3]
    length = np.linalg.norm(rays[:, 3:], axis=1)
    clear: Bool[ndarray, "n"] = surface.cast(rays).distance * length > length - ON_SURFACE
    return clear


def matchable_view(
    measured: Float32[ndarray, "h w"],
    instance: UInt8[ndarray, "_ _"],
    K: Float[ndarray, "3 3"],
    world_from_camera: Float[ndarray, "4 4"],
    surface: Surface | None = None,
    tolerance: tuple[float, float] = (0.005, 0.01),
    margin: int = 2,
    distrusted: Bool[ndarray, "h w"] | None = None,
) -> MatchableView:
    """A frame with the best depth available, its pixels grouped by instance.

    Args:
        measured: z-depth, metres; 0 means no measurement.
        surface: the fused surface of the scene.
        tolerance: (a, b): a measurement confirms the surface at depth z within a + b z metres.
        margin: pixels to stay away from the edge of a mask, where it is chance which surface a pixel shows.
        distrusted: pixels that are not matched, such as flying pixels.

    Raises:
        ValueError: `measured` and `instance` differ in size, or `margin` or a tolerance is negative.
    """
    if measured.shape != instance.shape:
        raise ValueError(f"measured and instance must have one size, got {measured.shape} and {instance.shape}")
    if min(margin, *tolerance) < 0:
        raise ValueError(f"margin and tolerance must be >= 0, got {margin} and {tolerance}")
    sure = instance if distrusted is None else np.where(distrusted, np.uint8(0), instance)
    depth, noise = measured, 0.0
    if surface is not None:
        where = np.flatnonzero(instance)
        width = instance.shape[1]
        uv = np.stack([where % width, where // width], axis=1).astype(np.float64)
        cast, cosine = cast_through(surface, uv, K, world_from_camera)
        rendered = np.zeros_like(measured)
        rendered.reshape(-1)[where] = np.where(np.isfinite(cast), cast, 0)
        depth, doubtful, noise = refined(measured, rendered, tolerance)
        sure = np.where(doubtful, np.uint8(0), sure)
        sure.reshape(-1)[where[cosine < GRAZING]] = 0
    instance, depth = np.ascontiguousarray(instance), np.ascontiguousarray(depth)
    steepest = EDGE_JUMP * tolerance[0], EDGE_JUMP * tolerance[1] + STEEPEST / K[0, 0]
    inner, pixels, first = inside(instance, np.ascontiguousarray(sure), depth, margin, steepest)
    return MatchableView(depth, instance, inner, pixels, first, K, world_from_camera, margin, noise)


@njit(inline="always")
def _is_jump(z, z_next, steepest):  # type: ignore[no-untyped-def]
    """Whether two neighbouring pixels show two surfaces; False where either has no depth."""
    return z > 0 and z_next > 0 and abs(z - z_next) > steepest[0] + steepest[1] * min(z, z_next)


@compiled
def inside(  # type: ignore[no-untyped-def]
    instance, sure, depth, margin, steepest
):
    """Labels of pixels that are sure, have depth, and whose neighbours within `margin` have the same label and lie on
    one surface, else 0 (h, w); the image's border is no edge. Also the flat indices of these pixels, grouped by label,
    and where each label begins (257,).

    One pass over the image: a window has one label where in each of its rows a run of that label spans its width. A
    jump in depth ends a run, along each row and along the middle column: no edge crosses a window without crossing one
    of these.

    Args:
        steepest: (a, b): from a pixel to the next, depth z of one surface changes by at most a + b z metres.
    """
    height, width = instance.shape
    inner = np.zeros((height, width), np.uint8)
    first = np.zeros(N_INSTANCES + 1, np.int64)
    # Rows above each pixel, itself included, that have one label throughout the window's width.
    rows = np.zeros(width, np.int64)
    begin, end = height, 0
    for v in range(height + margin):
        here = min(v, height - 1)
        row, above = instance[here], instance[max(min(v, height) - 1, 0)]
        labelled = np.flatnonzero(row)
        if len(labelled) == 0:
            rows[:] = 0
            continue
        left, right = labelled[0], labelled[-1] + 1
        rows[:left], rows[right:] = 0, 0
        run = left
        for u_end in range(left, right + margin):
            if left < u_end < width and (
                row[u_end] != row[u_end - 1] or _is_jump(depth[here, u_end], depth[here, u_end - 1], steepest)
            ):
                run = u_end
            u = u_end - margin
            if u < left:
                continue
            label = row[u]
            if label == 0 or run > max(u - margin, 0):
                rows[u] = 0
                continue
            if v == 0:
                rows[u] = margin + 1
            elif above[u] == label and (v >= height or not _is_jump(depth[v, u], depth[v - 1, u], steepest)):
                rows[u] += 1
            else:
                rows[u] = 1
            centre = v - margin
            if centre >= 0 and rows[u] > 2 * margin and sure[centre, u] == label and depth[centre, u] > 0:
                inner[centre, u] = label
                first[label + 1] += 1
                begin, end = min(begin, centre), max(end, centre + 1)
    for label in range(N_INSTANCES):
        first[label + 1] += first[label]
    pixels = np.empty(first[-1], np.int32)
    after = first[:-1].copy()
    for v in range(begin, end):
        for u in range(width):
            label = inner[v, u]
            if label > 0:
                pixels[after[label]] = v * width + u
                after[label] += 1
    return inner, pixels, first
