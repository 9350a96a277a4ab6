"""Rigid transforms and the pinhole camera.

A transform `a_from_b` takes coordinates in frame b to frame a. The camera frame is x right, y down, z forward; pixel
(0, 0) is the centre of the top-left pixel, so an image of width w spans u in [-0.5, w - 0.5].
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

RIGID_TOLERANCE = 1e-3
"""Largest deviation of R^T R from the identity that counts as rounding in a text file."""


def invert_rigid(a_from_b: Float[ndarray, "*n 4 4"]) -> Float[ndarray, "*n 4 4"]:
    """The transform `b_from_a`, exact to rounding for rigid transforms."""
    rotation = np.swapaxes(a_from_b[..., :3, :3], -1, -2)
    b_from_a = np.zeros_like(a_from_b)
    b_from_a[..., :3, :3] = rotation
    b_from_a[..., :3, 3] = -np.einsum("...ij,...j->...i", rotation, a_from_b[..., :3, 3])
    b_from_a[..., 3, 3] = 1.0
    return b_from_a


def transform(a_from_b: Float[ndarray, "4 4"], points_b: Float[ndarray, "*n 3"]) -> Float[ndarray, "*n 3"]:
    """The same points in frame a."""
    return points_b @ a_from_b[:3, :3].T + a_from_b[:3, 3]


def project(
    points_camera: Float[ndarray, "*n 3"], K: Float[ndarray, "3 3"]
) -> tuple[Float[ndarray, "*n 2"], Float[ndarray, "*n"]]:
    """Pixels (u, v) and z-depth in metres. Pixels of points with z <= 0 are NaN: they have no image."""
    z = points_camera[..., 2]
    in_front = np.where(z > 0, z, np.nan)
    u = K[0, 0] * points_camera[..., 0] / in_front + K[0, 1] * points_camera[..., 1] / in_front + K[0, 2]
    v = K[1, 1] * points_camera[..., 1] / in_front + K[1, 2]
    return np.stack([u, v], axis=-1), z


def unproject(
    uv: Float[ndarray, "*n 2"], depth: Float[ndarray, "*n"], K: Float[ndarray, "3 3"]
) -> Float[ndarray, "*n 3"]:
    """Points in the camera frame seen at pixels (u, v) at z-depth `depth` (metres)."""
    y = (uv[..., 1] - K[1, 2]) / K[1, 1]
    x = (uv[..., 0] - K[0, 2] - K[0, 1] * y) / K[0, 0]
    return np.stack([x * depth, y * depth, depth], axis=-1)


def pixel_grid(height: int, width: int) -> Float[ndarray, "h w 2"]:
    """The (u, v) of every pixel centre, indexed [v, u]."""
    v, u = np.mgrid[:height, :width].astype(np.float64)
    return np.stack([u, v], axis=-1)


def in_image(uv: Float[ndarray, "*n 2"], height: int, width: int) -> Bool[ndarray, "*n"]:
    """Pixels whose nearest pixel centre exists. NaN is outside."""
    u, v = uv[..., 0], uv[..., 1]
    return (u >= -0.5) & (u < width - 0.5) & (v >= -0.5) & (v < height - 0.5)


def scale_intrinsics(
    K: Float[ndarray, "3 3"], size: tuple[int, int], new_size: tuple[int, int]
) -> Float[ndarray, "3 3"]:
    """Intrinsics of the image resized from `size` to `new_size`, both (height, width).

    Resizing keeps the image's *edges*, and our pixel centres are integers, so the principal point is moved by half a
    pixel before and after.
    """
    factor = np.array([new_size[1] / size[1], new_size[0] / size[0]])
    scaled = K.copy()
    scaled[:2] *= factor[:, None]
    scaled[:2, 2] = (K[:2, 2] + 0.5) * factor - 0.5
    return scaled


def scale_pixels(
    uv: Float[ndarray, "*n 2"], size: tuple[int, int], new_size: tuple[int, int]
) -> Float[ndarray, "*n 2"]:
    """The same image positions after resizing from `size` to `new_size`, both (height, width)."""
    factor = np.array([new_size[1] / size[1], new_size[0] / size[0]], dtype=uv.dtype)
    return (uv + uv.dtype.type(0.5)) * factor - uv.dtype.type(0.5)


def rotation_angle(rotation: Float[ndarray, "*n 3 3"]) -> Float[ndarray, "*n"]:
    """Angle of a rotation, radians in [0, pi]. Accurate at small angles, unlike the arc cosine of the trace."""
    skew = rotation - np.swapaxes(rotation, -1, -2)
    sine = 0.5 * np.sqrt(skew[..., 2, 1] ** 2 + skew[..., 0, 2] ** 2 + skew[..., 1, 0] ** 2)
    cosine = 0.5 * (np.trace(rotation, axis1=-2, axis2=-1) - 1.0)
    return np.asarray(np.arctan2(sine, cosine))


def view_change(
    world_from_a: Float[ndarray, "*n 4 4"], world_from_b: Float[ndarray, "*n 4 4"]
) -> tuple[Float[ndarray, "*n"], Float[ndarray, "*n"]]:
    """Distance (metres) and rotation angle (radians) between cameras; leading axes broadcast."""
    distance = np.asarray(np.linalg.norm(world_from_a[..., :3, 3] - world_from_b[..., :3, 3], axis=-1))
    a_from_b = np.swapaxes(world_from_a[..., :3, :3], -1, -2) @ world_from_b[..., :3, :3]
    return distance, rotation_angle(a_from_b)


def rigid_fault(matrix: Float[ndarray, "4 4"], tolerance: float = RIGID_TOLERANCE) -> str:
    """Why `matrix` is not a rigid transform, in words for an error message; empty if it is one."""
    if not np.isfinite(matrix).all():
        return "a value that is not finite"
    if not np.allclose(matrix[3], [0, 0, 0, 1], atol=tolerance):
        return f"last row {matrix[3].tolist()}"
    rotation = matrix[:3, :3]
    determinant = float(np.linalg.det(rotation))
    if determinant < 0:
        return f"a mirrored frame (determinant {determinant:.4g})"
    lengths = np.linalg.norm(rotation, axis=0)
    if not np.allclose(lengths, 1.0, atol=tolerance):
        return f"a scaled frame (axis lengths {lengths[0]:.4g}, {lengths[1]:.4g}, {lengths[2]:.4g})"
    if not np.allclose(rotation.T @ rotation, np.eye(3), atol=tolerance):
        return "axes that are not perpendicular"
    return ""


def nearest_rigid(matrix: Float[ndarray, "4 4"]) -> Float[ndarray, "4 4"]:
    """The rigid transform closest to an almost rigid one, so that rounding in text files does not accumulate."""
    left, _, right = np.linalg.svd(matrix[:3, :3])
    rigid = np.eye(4)
    rigid[:3, :3] = left @ right
    rigid[:3, 3] = matrix[:3, 3]
    return rigid
