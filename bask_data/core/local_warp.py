"""Local change of the image around a point from one view to another: its rotation and scale."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8
from numpy import ndarray

from bask_data.core.geometry import in_image, invert_rigid, project, transform, unproject
from bask_data.core.match_errors import true_depth

WINDOW = 2
"""Half the window, pixels, that a surface's tangent plane is fitted in. Chosen, sensitivity not measured."""
SAME_SLOPE = 0.05
"""Share of a pixel's depth by which depths around it may differ and still be of its surface. Chosen; its sensitivity is
in docs/benchmarks.md."""
FRONTAL = 1e-3
"""Weight, against one pixel's measurement, of the prior that a surface faces the camera: it decides only in windows
with too few measurements. Chosen, sensitivity not measured."""


def surface_tangents(
    uv: Float[ndarray, "n 2"], depth: Float32[ndarray, "h w"], labels: UInt8[ndarray, "h w"], K: Float[ndarray, "3 3"]
) -> tuple[Float[ndarray, "n 3"], Float[ndarray, "n 3 2"]]:
    """The point of the surface at each pixel, camera frame, metres, and its derivatives along u and v, metres per
    pixel.

    The tangent plane is fitted to the depths of the same label around; inverse depth is linear over a plane's image.
    NaN where the nearest pixel has no depth or is outside the image.
    """
    height, width = depth.shape
    inside = in_image(uv, height, width)
    centre = np.rint(np.where(inside[:, None], uv, 0.0)).astype(np.int64).clip(0, [width - 1, height - 1])
    steps = np.arange(-WINDOW, WINDOW + 1)
    du, dv = (grid.ravel() for grid in np.meshgrid(steps, steps))
    u, v = centre[:, :1] + du, centre[:, 1:] + dv
    around = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    u, v = u.clip(0, width - 1), v.clip(0, height - 1)
    z, own = depth[v, u].astype(np.float64), depth[centre[:, 1], centre[:, 0]].astype(np.float64)
    same = labels[v, u] == labels[centre[:, 1], centre[:, 0]][:, None]
    fits = around & same & (z > 0) & (np.abs(z - own[:, None]) <= SAME_SLOPE * own[:, None])
    offset = np.stack([u - uv[:, :1], v - uv[:, 1:], np.ones(u.shape)], axis=-1) * fits[..., None]
    inverse = np.where(fits, 1.0 / np.where(z > 0, z, 1.0), 0.0)
    normal = np.einsum("npi,npj->nij", offset, offset) + FRONTAL * np.diag([1.0, 1.0, 0.0])
    known = inside & (own > 0)
    normal[~known] = np.eye(3)
    plane = np.linalg.solve(normal, np.einsum("npi,np->ni", offset, inverse)[..., None])[..., 0]
    depth_there = np.where(known, true_depth(depth, labels, uv), np.nan)
    points = unproject(uv, depth_there, K)
    # X = z ray; 1 / z = a u + b v + c, so dz/du = -z^2 a.
    ray = points / depth_there[:, None]
    ray_moves = np.array([[1 / K[0, 0], -K[0, 1] / (K[0, 0] * K[1, 1])], [0, 1 / K[1, 1]], [0, 0]])
    z = depth_there[:, None, None]
    return points, z * ray_moves - z**2 * ray[:, :, None] * plane[:, None, :2]


def image_warp(
    points_camera: Float[ndarray, "n 3"], tangents_camera: Float[ndarray, "n 3 2"], K: Float[ndarray, "3 3"]
) -> Float[ndarray, "n 2 2"]:
    """Derivatives of a point's pixel (rows u, v) along its tangents (columns).

    With the tangents of `surface_tangents` from another view, it is the affine part of the map from that view's image.
    """
    x, y, z = points_camera.T
    zero = np.zeros(len(x))
    u_by_point = np.stack([K[0, 0] / z, K[0, 1] / z, -(K[0, 0] * x + K[0, 1] * y) / z**2], axis=-1)
    v_by_point = np.stack([zero, K[1, 1] / z, -K[1, 1] * y / z**2], axis=-1)
    return np.stack([u_by_point, v_by_point], axis=1) @ tangents_camera


def turn_of(warp: Float[ndarray, "n 2 2"]) -> Float[ndarray, " n"]:
    """The angle of the rotation closest to each warp, radians in [0, pi], without its sign."""
    return np.abs(np.arctan2(warp[:, 1, 0] - warp[:, 0, 1], warp[:, 0, 0] + warp[:, 1, 1]))


def visible_share(
    points_world: Float[ndarray, "m 3"],
    label: int,
    depth: Float[ndarray, "h w"],
    labels: UInt8[ndarray, "h w"],
    K: Float[ndarray, "3 3"],
    world_from_camera: Float[ndarray, "4 4"],
    tolerance: float = 0.005,
) -> float:
    """The visible share of an object's amodal mask; NaN where none of it is in the image.

    Hidden are pixels on or between the projections of its points that show something nearer.

    Args:
        points_world: of its whole surface, in the image not farther apart than two or three pixels.
        label: of the object in `labels`.
        tolerance: metres by which an occluder must be nearer.
    """
    height, width = depth.shape
    uv, z = project(transform(invert_rigid(world_from_camera), points_world), K)
    inside = in_image(uv, height, width)
    u, v = np.rint(uv[inside]).astype(np.int64).clip(0, [width - 1, height - 1]).T
    inverse = np.zeros((height, width), np.float32)
    np.maximum.at(inverse, (v, u), (1 / z[inside]).astype(np.float32))
    # Closing fills the gaps between points and leaves the outline where it is.
    inverse = cv2.morphologyEx(inverse, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    shown = labels == label
    in_front = (depth > 0) & (inverse * (depth + np.float32(tolerance)) < 1)
    hidden: Bool[ndarray, "h w"] = ~shown & (inverse > 0) & in_front
    n_shown, n_hidden = np.count_nonzero(shown), np.count_nonzero(hidden)
    return n_shown / (n_shown + n_hidden) if n_shown + n_hidden else float("nan")
