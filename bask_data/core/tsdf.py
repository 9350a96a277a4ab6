"""Fusion of depth images into a triangle mesh: a truncated signed distance field on Open3D's sparse voxel blocks."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import open3d as o3d
from jaxtyping import Bool, Float, Float32, Int, Int32, UInt8
from numpy import ndarray

from bask_data.core.geometry import invert_rigid, rigid_fault, transform, unproject, view_change

BLOCK_RESOLUTION = 8
"""Voxels along the edge of a block; 16 fuses three times slower on a CPU and holds twice the memory."""

BLOCK_BYTES = BLOCK_RESOLUTION**3 * 4 * 5
"""Distance, weight and three colours per voxel, float32. With 16-bit colours the running mean loses a fraction in
every frame and darkens."""

HALF_PIXEL = 0.5
"""Open3D rounds pixels down, so its pixel centres lie at one half; ours are integers. Without the shift every surface
is off by half a pixel."""

HALF_VOXEL = 0.5
"""The lattice is moved by half a voxel in the world, because calibrated tables lie exactly at z = 0 and a plane
through lattice points extracts as twice the vertices, half of them in slivers."""

FARTHEST = 1e3
"""Metres; Open3D wants a limit although the caller has already cut the depth."""


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh in the world frame, in canonical order: equal surfaces have equal bytes."""

    vertices: Float32[ndarray, "n 3"]
    triangles: Int32[ndarray, "m 3"]
    colors: UInt8[ndarray, "n 3"]


class Volume:
    """A surface in the making. Takes frames one by one and keeps none of them: memory follows the surface, not the
    number of frames.

    Args:
        voxel_size: edge of a voxel, metres.
        truncation_voxels: distance on both sides of a surface that is kept, in voxels.
        bounds: (2, 3) lowest and highest corner of the workspace, world frame, metres; None for no limit.
        n_blocks: voxel blocks expected (`expected_blocks`). More than that are possible at the price of a pause to
            re-hash.

    Raises:
        ValueError: a size is not positive, or the bounds enclose nothing.
    """

    def __init__(
        self,
        voxel_size: float,
        truncation_voxels: float = 5.0,
        bounds: Float[ndarray, "2 3"] | None = None,
        n_blocks: int = 10_000,
    ) -> None:
        if not voxel_size > 0:
            raise ValueError(f"voxel_size: expected > 0 metres, got {voxel_size}")
        if not truncation_voxels >= 1:
            raise ValueError(f"truncation_voxels: expected at least 1 voxel, got {truncation_voxels}")
        if bounds is not None and not (bounds[0] < bounds[1]).all():
            raise ValueError(f"bounds: expected lowest below highest corner, got {bounds.tolist()}")
        self.voxel_size = voxel_size
        self.truncation_voxels = truncation_voxels
        self.bounds = bounds
        self.n_integrated = 0
        float32 = o3d.core.float32
        self._grid = o3d.t.geometry.VoxelBlockGrid(
            ("tsdf", "weight", "color"),
            (float32, float32, float32),
            [o3d.core.SizeVector([n_channels]) for n_channels in (1, 1, 3)],
            voxel_size,
            BLOCK_RESOLUTION,
            n_blocks,
        )
        self._world_from_grid = np.eye(4)
        self._world_from_grid[:3, 3] = HALF_VOXEL * voxel_size

    @property
    def n_blocks(self) -> int:
        """Voxel blocks in use."""
        return int(self._grid.hashmap().size())

    def integrate(
        self,
        depth: Float32[ndarray, "h w"],
        rgb: UInt8[ndarray, "h_rgb w_rgb 3"],
        K: Float[ndarray, "3 3"],
        world_from_camera: Float[ndarray, "4 4"],
    ) -> bool:
        """Fuse one frame; False when it measures nothing inside the bounds and so adds nothing.

        Args:
            depth: z-depth, metres; 0 means no measurement. Cut and cleaned already (`depth.cleaned`).

        Raises:
            ValueError: the transform is not rigid, or the images differ in size. Open3D would take either without a
                word.
        """
        if fault := rigid_fault(world_from_camera):
            raise ValueError(f"world_from_camera: expected a rigid transform, got {fault}")
        if depth.shape != rgb.shape[:2]:
            raise ValueError(f"rgb: expected the size of the depth image {depth.shape}, got {rgb.shape[:2]}")
        from_numpy = o3d.core.Tensor.from_numpy
        if not (depth > 0).any():  # Open3D aborts the process here.
            return False
        shift = np.array([[0, 0, HALF_PIXEL], [0, 0, HALF_PIXEL], [0, 0, 0]])
        K_corner = from_numpy(K + shift)
        camera_from_grid = from_numpy(invert_rigid(world_from_camera) @ self._world_from_grid)
        depth_image = o3d.t.geometry.Image(from_numpy(np.ascontiguousarray(depth)))
        rgb_image = o3d.t.geometry.Image(from_numpy(np.multiply(rgb, np.float32(1 / 255), dtype=np.float32)))
        blocks = self._grid.compute_unique_block_coordinates(
            depth_image, K_corner, camera_from_grid, 1.0, FARTHEST, self.truncation_voxels
        )
        if self.bounds is not None:
            blocks = blocks[from_numpy(self._inside(blocks.numpy()))]
        if blocks.shape[0] == 0:
            return False
        self._grid.integrate(
            blocks,
            depth_image,
            rgb_image,
            K_corner,
            K_corner,
            camera_from_grid,
            1.0,
            FARTHEST,
            self.truncation_voxels,
        )
        self.n_integrated += 1
        return True

    def _inside(self, blocks: Int32[ndarray, "n 3"]) -> Bool[ndarray, "n"]:
        """Blocks that share some volume with the bounds, and one voxel around them, which the surface at the bounds
        is made from."""
        assert self.bounds is not None
        lowest = (blocks * BLOCK_RESOLUTION + HALF_VOXEL) * self.voxel_size
        highest = lowest + BLOCK_RESOLUTION * self.voxel_size
        margin = self.voxel_size
        return ((highest > self.bounds[0] - margin) & (lowest < self.bounds[1] + margin)).all(axis=1)

    def mesh(self, min_views: int = 3) -> Mesh:
        """The surface, cut to the bounds. Empty when nothing was fused.

        Args:
            min_views: frames that must have measured a voxel. Never more than a tenth of the frames fused, so that
                few views give a surface.
        """
        if self.n_blocks == 0:
            return canonical(np.zeros((0, 3)), np.zeros((0, 3), np.int64), np.zeros((0, 3)))
        needed = min(min_views, max(1, self.n_integrated // 10))
        # Open3D keeps voxels whose weight is strictly above the threshold.
        extracted = self._grid.extract_triangle_mesh(needed - 0.5).cpu()
        if "positions" not in extracted.vertex or len(extracted.vertex.positions) == 0:
            return canonical(np.zeros((0, 3)), np.zeros((0, 3), np.int64), np.zeros((0, 3)))
        vertices = extracted.vertex.positions.numpy() + np.float32(HALF_VOXEL * self.voxel_size)
        triangles = extracted.triangle.indices.numpy().astype(np.int64)
        colors = extracted.vertex.colors.numpy()
        if self.bounds is not None:
            inside = ((vertices >= self.bounds[0]) & (vertices <= self.bounds[1])).all(axis=1)
            triangles = triangles[inside[triangles].all(axis=1)]
        return canonical(vertices, triangles, colors)


def canonical(vertices: Float[ndarray, "n 3"], triangles: Int[ndarray, "m 3"], colors: Float[ndarray, "n 3"]) -> Mesh:
    """The same surface in an order that depends on nothing but itself: Open3D's depends on its threads.

    Vertices at one place become one, triangles without area by that and vertices of no triangle go; the rest is
    sorted, and a triangle
    begins with its lowest vertex, its winding kept.

    Args:
        colors: 0 to 1.
    """
    vertices = vertices.astype(np.float32) + np.float32(0)  # Adding zero makes -0.0 into 0.0, which has other bytes.
    colors = np.clip(np.rint(colors * 255), 0, 255).astype(np.uint8)
    order = np.lexsort((*colors.T[::-1], *vertices.T[::-1]))
    same_as_last = (np.diff(vertices[order], axis=0, prepend=np.nan) == 0).all(axis=1)
    new_index = np.empty(len(vertices), np.int64)
    new_index[order] = np.cumsum(~same_as_last) - 1
    kept = order[~same_as_last]
    corners = new_index[triangles]
    corners = corners[(corners != np.roll(corners, 1, axis=1)).all(axis=1)]
    used = np.zeros(len(kept), bool)
    used[corners] = True
    corners = (np.cumsum(used) - 1)[corners]
    start = corners.argmin(axis=1) if len(corners) else np.zeros(0, np.int64)
    corners = np.take_along_axis(corners, (start[:, None] + np.arange(3)) % 3, axis=1)
    corners = corners[np.lexsort(corners.T[::-1])]
    return Mesh(vertices[kept][used], corners.astype(np.int32), colors[kept][used])


def distinct_views(
    world_from_cameras: Float[ndarray, "t 4 4"], min_distance: float, min_angle: float
) -> Int[ndarray, "kept"]:
    """Frames in order, each of which moved `min_distance` metres or turned `min_angle` radians since the last one kept.

    A limit of 0 does not count; with both 0 every frame is kept.
    """
    if min_distance < 0 or min_angle < 0:
        raise ValueError(f"view change: expected limits >= 0, got {min_distance} m and {min_angle} rad")
    if min_distance == 0 and min_angle == 0:
        return np.arange(len(world_from_cameras))
    kept = [0] if len(world_from_cameras) else []
    for i_frame in range(1, len(world_from_cameras)):
        last, this = kept[-1], i_frame
        distance, angle = view_change(world_from_cameras[last : last + 1], world_from_cameras[this : this + 1])
        if (0 < min_distance <= distance[0]) or (0 < min_angle <= angle[0]):
            kept.append(i_frame)
    return np.array(kept, dtype=np.int64)


@dataclass(frozen=True)
class Glimpse:
    """What one frame measured, thinned out: enough to lay out the volume before it is filled."""

    points_world: Float[ndarray, "n 3"]
    eye_world: Float[ndarray, "3"]


def glimpse(
    depth: Float32[ndarray, "h w"],
    K: Float[ndarray, "3 3"],
    world_from_camera: Float[ndarray, "4 4"],
    n_points: int = 5000,
) -> Glimpse:
    """About `n_points` measured points of a frame, evenly over those it has (sensors that measure every other pixel
    are no different)."""
    v, u = np.nonzero(depth)
    step = max(1, len(v) // n_points)
    v, u = v[::step], u[::step]
    points = unproject(np.stack([u, v], axis=-1).astype(np.float64), depth[v, u].astype(np.float64), K)
    return Glimpse(transform(world_from_camera, points), world_from_camera[:3, 3])


def estimated_workspace(
    glimpses: Iterable[Glimpse], cell: float = 0.05, min_share: float = 0.2, margin: float = 0.02
) -> Float[ndarray, "2 3"] | None:
    """The box around what the frames agree on; None when they measured nothing.

    Space is cut into cells; a cell counts when at least two frames and `min_share` of all frames measured a point in
    it, so that a glance at
    a far wall does not. The box holds 99 % of the points in such cells on every axis. When no cells are shared, all
    points count.

    Args:
        cell: edge of a cell, metres.
        margin: metres added on each side.
    """
    clouds = [one.points_world for one in glimpses if len(one.points_world)]
    if not clouds:
        return None
    points = np.concatenate(clouds)
    cells, i_cell = np.unique(np.floor(points / cell).astype(np.int64), axis=0, return_inverse=True)
    i_cell = i_cell.reshape(-1)
    i_frame = np.repeat(np.arange(len(clouds)), [len(cloud) for cloud in clouds])
    n_frames = np.bincount(np.unique(i_cell * len(clouds) + i_frame) // len(clouds), minlength=len(cells))
    shared = n_frames >= min(len(clouds), max(2, int(np.ceil(min_share * len(clouds)))))
    agreed = points[shared[i_cell]] if shared.any() else points
    lowest, highest = np.percentile(agreed, [0.5, 99.5], axis=0)
    return np.stack([lowest - margin, highest + margin])


def expected_blocks(
    glimpses: Iterable[Glimpse],
    voxel_size: float,
    truncation_voxels: float = 5.0,
    bounds: Float[ndarray, "2 3"] | None = None,
) -> int:
    """Voxel blocks the surface will need, with room to spare: re-hashing a full table stops everything for seconds.

    Counts the blocks within the truncation distance along the rays of the points, and adds half for what was not
    sampled.
    """
    edge = BLOCK_RESOLUTION * voxel_size
    touched = []
    for one in glimpses:
        rays = one.points_world - one.eye_world
        rays = rays / np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-9)
        reach = truncation_voxels * voxel_size
        points = np.concatenate([one.points_world + step * reach * rays for step in (-1.0, 0.0, 1.0)])
        if bounds is not None:
            points = points[((points > bounds[0] - edge) & (points < bounds[1] + edge)).all(axis=1)]
        touched.append(np.unique(np.floor(points / edge).astype(np.int64), axis=0))
    n_touched = len(np.unique(np.concatenate(touched), axis=0)) if touched else 0
    return 1000 + n_touched * 3 // 2
