"""Ray casting: meshes, and the rays through a camera's pixels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
import open3d as o3d
from jaxtyping import Bool, Float, Float32, Int, UInt32
from numpy import ndarray

from bask_data.core.compiled import compiled


class Hits(NamedTuple):
    """The first hits of n rays (origin, direction) on a surface.

    Attributes:
        distance: ray parameter: in units of the direction's length; infinity for no hit.
        triangle: row of the triangle hit; larger than any row for no hit.
        corner_weights: barycentric weights of that triangle's second and third corner.
        normal: of that triangle, unit length, on the side from which its corners run counter-clockwise.
    """

    distance: Float32[ndarray, "n"]
    triangle: UInt32[ndarray, "n"]
    corner_weights: Float32[ndarray, "n 2"]
    normal: Float32[ndarray, "n 3"]


class Surface:
    """A triangle mesh that rays can be cast at.

    Args:
        vertices: metres, world.
        triangles: rows of `vertices`.
    """

    def __init__(self, vertices: Float32[ndarray, "n 3"], triangles: Int[ndarray, "m 3"]) -> None:
        self.n_triangles = len(triangles)
        self._scene, tensor = o3d.t.geometry.RaycastingScene(), o3d.core.Tensor.from_numpy
        self._scene.add_triangles(
            tensor(np.ascontiguousarray(vertices)), tensor(np.ascontiguousarray(triangles, dtype=np.uint32))
        )

    def cast(self, rays: Float32[ndarray, "n 6"]) -> Hits:
        """The first hit of each ray (origin, direction), world frame."""
        hits = self._scene.cast_rays(o3d.core.Tensor.from_numpy(rays))
        names = "t_hit", "primitive_ids", "primitive_uvs", "primitive_normals"
        return Hits(*(hits[name].numpy() for name in names))

    def meets(self, rays: Float32[ndarray, "n 6"]) -> Bool[ndarray, "n"]:
        """Whether each ray hits anything; cheaper than `cast`."""
        met: Bool[ndarray, "n"] = self._scene.test_occlusions(o3d.core.Tensor.from_numpy(rays)).numpy()
        return met


def ray_directions(K: Float[ndarray, "3 3"], height: int, width: int) -> Float32[ndarray, "h w 3"]:
    """Directions in the camera frame through the pixel centres, with z = 1, so that a hit's ray parameter is its
    z-depth.

    Open3D's own pinhole rays go through pixel corners; that half pixel costs masks 4 % IoU.
    """
    # `unproject` of the pixel grid, to the last bit, in less than half its time: they may be of one frame only.
    y = (np.arange(height)[:, None] - K[1, 2]) / K[1, 1]
    directions = np.ones((height, width, 3), np.float32)
    directions[..., 0] = (np.arange(width) - K[0, 2] - K[0, 1] * y) / K[0, 0]
    directions[..., 1] = y
    return directions


class CameraDirections:
    """`ray_directions` of a camera's frames, computed again only where the intrinsics change.

    Args:
        Ks: intrinsics of each frame, pixels.
    """

    def __init__(self, Ks: Float[ndarray, "t 3 3"], height: int, width: int) -> None:
        self._Ks, self._size = Ks, (height, width)
        self._last: tuple[ndarray, ndarray] | None = None

    def __getitem__(self, i_frame: int) -> Float32[ndarray, "h w 3"]:
        K = self._Ks[i_frame]
        if self._last is None or not np.array_equal(self._last[0], K):
            self._last = K, ray_directions(K, *self._size)
        return self._last[1]


@dataclass(frozen=True)
class Rays:
    """The rays through a camera's pixels, world frame; their parameter is the z-depth.

    Args:
        origin: the camera's centre, metres.
        directions: of each pixel's ray.
    """

    origin: Float32[ndarray, "3"]
    directions: Float32[ndarray, "h w 3"]

    def through(self, chosen: Bool[ndarray, "h w"]) -> Float32[ndarray, "n 6"]:
        """Origin and direction of the rays through the chosen pixels, row by row."""
        rays: Float32[ndarray, "n 6"] = _through(self.origin, self.directions, chosen, np.count_nonzero(chosen))
        return rays

    def at(self, i_pixels: Int[ndarray, "n"]) -> Float32[ndarray, "n 6"]:
        """Origin and direction of the rays through pixels given by their flat index."""
        rays = np.empty((len(i_pixels), 6), np.float32)
        rays[:, :3], rays[:, 3:] = self.origin, self.directions.reshape(-1, 3)[i_pixels]
        return rays


def rays_of(directions_camera: Float32[ndarray, "h w 3"], world_from_camera: Float[ndarray, "4 4"]) -> Rays:
    """The rays of a camera at a pose.

    Args:
        directions_camera: `ray_directions` of the camera.
    """
    # A matrix product with three columns takes NumPy ten times as long.
    directions = cv2.transform(directions_camera, world_from_camera[:3, :3].astype(np.float32))
    return Rays(world_from_camera[:3, 3].astype(np.float32), directions)


@compiled
def _through(origin, directions, chosen, n_chosen):  # type: ignore[no-untyped-def]
    rays, i = np.empty((n_chosen, 6), np.float32), 0
    for v in range(chosen.shape[0]):
        for u in range(chosen.shape[1]):
            if chosen[v, u]:
                for axis in range(3):
                    rays[i, axis], rays[i, 3 + axis] = origin[axis], directions[v, u, axis]
                i += 1
    return rays
