"""Depth images as surfaces: points with normals, and where those of one view meet the depth of another."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32
from numpy import ndarray

from bask_data.core.compiled import compiled
from bask_data.core.geometry import rotation_angle

SURFACE_POINTS = 800
"""Points of a view, spread evenly over what was measured. Sensitivity not measured."""

WINDOW_SHARE = 1 / 64
"""Half the window that a normal is fitted in, as a share of the image's width: 4 of 256 pixels, 10 of 640, where depth
that was registered to colour is sparse. Sensitivity not measured."""

SAME_SURFACE = 0.03
"""Depths of one window are on one surface if they differ by at most this share. Sensitivity not measured."""

LEAST_IN_WINDOW = 12
"""Measured pixels that a normal needs."""

ROUGHEST = 0.012
"""Largest RMS of a window's depth about its plane, as a share of the depth; more is an edge or clutter. Three times the
noise of a good sensor at 1 m. Sensitivity not measured."""

STEEPEST_COSINE = 0.25
"""Least cosine between a normal and the line of sight: depth of surfaces that are grazed is poor."""

FIXED_SHARE, FIXED_CHANGE = 0.8, 0.015
"""A pixel shows something fixed to the camera if in this share of the frames its depth changes by no more than this
share of it, while the camera turns. Sensitivity not measured."""

FIXED_TURN = np.radians(10.0)
"""Angle that the camera must turn for pixels of constant depth to be fixed to it: a table seen from above stays as far
away while the camera moves sideways."""


@dataclass(frozen=True)
class SurfaceView:
    """A depth image with points of its surfaces.

    Args:
        depth: metres, 0 = none.
        points: camera frame, metres.
        normals: unit length, towards the camera.
    """

    depth: Float32[ndarray, "h w"]
    K: Float[ndarray, "3 3"]
    points: Float[ndarray, "n 3"]
    normals: Float[ndarray, "n 3"]


def surface_view(
    depth: Float32[ndarray, "h w"], K: Float[ndarray, "3 3"], n_points: int = SURFACE_POINTS
) -> SurfaceView:
    """A view with points that lie on smooth surfaces, each smoothed by the plane fitted around it."""
    depth = np.ascontiguousarray(depth)
    v, u = np.nonzero(depth > 0)
    # More than are kept, as some lie at edges.
    chosen = np.unique(np.linspace(0, len(u) - 1, 2 * n_points).astype(int)) if len(u) else np.zeros(0, int)
    radius = max(3, round(depth.shape[1] * WINDOW_SHARE))
    points, normals, is_smooth = _fitted(
        u[chosen], v[chosen], depth, K, radius, SAME_SURFACE, LEAST_IN_WINDOW, ROUGHEST, STEEPEST_COSINE
    )
    kept = np.flatnonzero(is_smooth)
    kept = kept[np.unique(np.linspace(0, len(kept) - 1, n_points).astype(int))] if len(kept) else kept
    return SurfaceView(depth, K, points[kept], normals[kept])


def angles_between(world_from_cameras: Float[ndarray, "t 4 4"]) -> Float[ndarray, "t t"]:
    """Angle between each two cameras, radians."""
    rotations = world_from_cameras[:, :3, :3]
    return rotation_angle(np.einsum("aji,bjk->abik", rotations, rotations))


def fixed_to_camera(
    depths: Sequence[Float32[ndarray, "h w"]], world_from_cameras: Float[ndarray, "t 4 4"]
) -> Bool[ndarray, "h w"]:
    """Pixels that show something fixed to the camera, such as a gripper: their depth is constant while it turns.

    Args:
        depths: of some frames, spread over the recording, metres.
    """
    none = np.zeros(depths[0].shape, bool)
    if len(depths) < 5 or angles_between(world_from_cameras).max() < FIXED_TURN:
        return none
    stack = np.stack(depths)
    measured = stack > 0
    n_measured = measured.sum(axis=0)
    order = np.sort(np.where(measured, stack, np.inf), axis=0)
    median = np.take_along_axis(order, np.maximum(n_measured - 1, 0)[None] // 2, axis=0)[0]
    median = np.where(n_measured > 0, median, 0)
    constant = measured & (np.abs(stack - median) <= FIXED_CHANGE * median)
    return np.asarray((n_measured >= max(4, len(depths) // 3)) & (constant.sum(axis=0) >= FIXED_SHARE * n_measured))


@dataclass(frozen=True)
class Meetings:
    """Points of view a and what view b measured where they project.

    Args:
        points_a, normals_a: of those points that project onto measured depth.
        points_b: measured there, in b's camera frame, metres.
        n_points: points of view a in all.
    """

    points_a: Float[ndarray, "n 3"]
    normals_a: Float[ndarray, "n 3"]
    points_b: Float[ndarray, "n 3"]
    n_points: int


def meetings(a: SurfaceView, b: SurfaceView, b_from_a: Float[ndarray, "4 4"]) -> Meetings:
    """Where points of a meet the depth of b, by projection."""
    points_b, is_measured = _measured_at(a.points, b.depth, b.K, b_from_a)
    return Meetings(a.points[is_measured], a.normals[is_measured], points_b[is_measured], len(a.points))


@compiled
def _fitted(u, v, depth, K, radius, same, least, roughest, steepest):  # type: ignore[no-untyped-def]
    """Points and normals by a plane in each pixel's window: on a plane, 1 / z is linear in the pixel."""
    height, width = depth.shape
    n = len(u)
    points, normals, is_smooth = np.zeros((n, 3)), np.zeros((n, 3)), np.zeros(n, np.bool_)
    for i in range(n):
        z0 = depth[v[i], u[i]]
        # Normal equations of 1 / z = a du + b dv + c.
        uu, uv, vv, su, sv, yu, yv, ys, n_in = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0
        for dv in range(-radius, radius + 1):
            for du in range(-radius, radius + 1):
                x_, y_ = u[i] + du, v[i] + dv
                if x_ < 0 or y_ < 0 or x_ >= width or y_ >= height:
                    continue
                z = depth[y_, x_]
                if z <= 0 or abs(z - z0) > same * z0:
                    continue
                n_in += 1
                uu += du * du
                uv += du * dv
                vv += dv * dv
                su += du
                sv += dv
                yu += du / z
                yv += dv / z
                ys += 1 / z
        if n_in < least:
            continue
        # Reduced by the means: two equations are left.
        uu, uv, vv = uu - su * su / n_in, uv - su * sv / n_in, vv - sv * sv / n_in
        yu, yv = yu - su * ys / n_in, yv - sv * ys / n_in
        determinant = uu * vv - uv * uv
        if determinant < 1e-6:
            continue
        a, b = (vv * yu - uv * yv) / determinant, (uu * yv - uv * yu) / determinant
        c = (ys - a * su - b * sv) / n_in
        if c <= 0:
            continue
        total = 0.0
        for dv in range(-radius, radius + 1):
            for du in range(-radius, radius + 1):
                x_, y_ = u[i] + du, v[i] + dv
                if x_ < 0 or y_ < 0 or x_ >= width or y_ >= height:
                    continue
                z = depth[y_, x_]
                if z > 0 and abs(z - z0) <= same * z0:
                    total += ((a * du + b * dv + c) * z - 1) ** 2
        if total > n_in * roughest * roughest:
            continue
        # 1 / z = a (u - u0) + b (v - v0) + c with u = fx X / Z + cx gives a fx X + b fy Y + (...) Z = 1.
        nx, ny = a * K[0, 0], b * K[1, 1]
        nz = a * (K[0, 2] - u[i]) + b * (K[1, 2] - v[i]) + c
        length = np.sqrt(nx * nx + ny * ny + nz * nz)
        px, py, pz = (u[i] - K[0, 2]) / K[0, 0] / c, (v[i] - K[1, 2]) / K[1, 1] / c, 1.0 / c
        # The plane is n.X = 1 with n away from the camera; the distance of the plane is 1 / |n|.
        if 1.0 / length < steepest * np.sqrt(px * px + py * py + pz * pz):
            continue
        points[i, 0], points[i, 1], points[i, 2] = px, py, pz
        normals[i, 0], normals[i, 1], normals[i, 2] = -nx / length, -ny / length, -nz / length
        is_smooth[i] = True
    return points, normals, is_smooth


@compiled
def _measured_at(points, depth, K, b_from_a):  # type: ignore[no-untyped-def]
    height, width = depth.shape
    n = len(points)
    found, is_measured = np.zeros((n, 3)), np.zeros(n, np.bool_)
    for i in range(n):
        p0, p1, p2 = points[i, 0], points[i, 1], points[i, 2]
        q0 = b_from_a[0, 0] * p0 + b_from_a[0, 1] * p1 + b_from_a[0, 2] * p2 + b_from_a[0, 3]
        q1 = b_from_a[1, 0] * p0 + b_from_a[1, 1] * p1 + b_from_a[1, 2] * p2 + b_from_a[1, 3]
        q2 = b_from_a[2, 0] * p0 + b_from_a[2, 1] * p1 + b_from_a[2, 2] * p2 + b_from_a[2, 3]
        if q2 <= 1e-9:
            continue
        u = int(np.floor(K[0, 0] * q0 / q2 + K[0, 2] + 0.5))
        v = int(np.floor(K[1, 1] * q1 / q2 + K[1, 2] + 0.5))
        if u < 0 or v < 0 or u >= width or v >= height or depth[v, u] <= 0:
            continue
        z = depth[v, u]
        found[i, 0], found[i, 1], found[i, 2] = (u - K[0, 2]) / K[0, 0] * z, (v - K[1, 2]) / K[1, 1] * z, z
        is_measured[i] = True
    return found, is_measured
