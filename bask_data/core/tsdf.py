"""Fusion of depth images into a triangle mesh: a truncated signed distance field on Open3D's sparse voxel blocks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import open3d as o3d
from jaxtyping import Bool, Float, Float32, Int, Int32, UInt8
from numpy import ndarray

from bask_data.core.geometry import invert_rigid, rigid_fault, view_change

BLOCK_RESOLUTION = 8
"""Voxels along the edge of a block; with 16, fusion took three times as long on a CPU and twice the memory."""

BLOCK_BYTES = BLOCK_RESOLUTION**3 * 4 * 5
"""Distance, weight and three colours per voxel, float32. With 16-bit colours the running mean loses a fraction in
every frame and darkens."""

HALF_PIXEL = 0.5
"""Open3D rounds pixels down, so its pixel centres lie at one half; ours are integers. Without the shift every surface
is off by half a pixel."""

HALF_VOXEL = 0.5
"""Offset of the lattice in the world, voxels: calibrated tables are exactly at z = 0, and a plane through lattice
points is extracted with twice the vertices, half of them in slivers."""

FARTHEST = 1e3
"""Metres; Open3D requires a limit although the depth is already limited."""

GROWTH = 1.25
"""Capacity of a volume that has to grow, as a multiple of what it needs. Open3D alone would double it. Chosen,
sensitivity not measured."""

ROOM, LEAST_ROOM = 1.1, 256
"""Blocks reserved for each that is expected, and in addition: a tenth more memory avoids growing, when the old and the
new table both exist. Chosen, sensitivity not measured."""

EXTRACTION_BYTES = 10_000
"""Memory per block during extraction: Open3D's index of the vertices on a block's edges, 16 bytes a voxel, and the
vertices. Measured: 8 to 10 kB."""


class VolumeTooLarge(Exception):
    """More voxel blocks are needed than are allowed.

    Args:
        n_needed: blocks.
    """

    def __init__(self, n_needed: int) -> None:
        super().__init__(f"{n_needed} voxel blocks")
        self.n_needed = n_needed


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh in the world frame, in canonical order: equal surfaces have equal bytes."""

    vertices: Float32[ndarray, "n 3"]
    triangles: Int32[ndarray, "m 3"]
    colors: UInt8[ndarray, "n 3"]


class Volume:
    """A TSDF volume. Fuses frames one by one and keeps none: memory depends on the surface, not on the number of
    frames.

    Args:
        voxel_size: edge of a voxel, metres.
        truncation_voxels: distance around a surface in which the TSDF is kept, voxels.
        bounds: (2, 3) lowest and highest corner of the workspace, world frame, metres; None for no limit.
        origin: point of the world where the lattice of voxels begins. If it moves with the scene, so does the surface.
        n_blocks: voxel blocks to reserve (`expected_blocks`). If more are needed the volume grows, which takes seconds
            and, for a moment, the memory of the old and the new one.
        max_blocks: most blocks it may grow to; None for no limit.

    Raises:
        ValueError: a size is not positive, or the bounds enclose nothing.
    """

    def __init__(
        self,
        voxel_size: float,
        truncation_voxels: float = 5.0,
        bounds: Float[ndarray, "2 3"] | None = None,
        n_blocks: int = 10_000,
        max_blocks: int | None = None,
        origin: Float[ndarray, "3"] | None = None,
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
        self.origin = np.zeros(3) if origin is None else origin
        self.n_integrated = 0
        self.n_grown = 0
        self.max_blocks = max_blocks
        self._grid = _grid(voxel_size, room_for(n_blocks))

    @property
    def n_blocks(self) -> int:
        """Voxel blocks in use."""
        return int(self._grid.hashmap().size())

    @property
    def capacity(self) -> int:
        """Voxel blocks reserved."""
        return int(self._grid.hashmap().capacity())

    def integrate(
        self,
        depth: Float32[ndarray, "h w"],
        rgb: UInt8[ndarray, "h_rgb w_rgb 3"],
        K: Float[ndarray, "3 3"],
        world_from_camera: Float[ndarray, "4 4"],
    ) -> bool:
        """Fuse one frame; False if it has no measurement inside the bounds.

        Args:
            depth: z-depth, metres; 0 means no measurement. Already cleaned (`depth.cleaned`).

        Raises:
            ValueError: the transform is not rigid, or the images differ in size. Open3D would accept both silently.
            VolumeTooLarge: it needs more blocks than allowed.
        """
        if depth.shape != rgb.shape[:2]:
            raise ValueError(f"rgb: expected the size of the depth image {depth.shape}, got {rgb.shape[:2]}")
        view = _View.of(depth, K, world_from_camera, self.voxel_size, self.origin)
        if view is None:
            return False
        from_numpy = o3d.core.Tensor.from_numpy
        rgb_image = o3d.t.geometry.Image(from_numpy(np.multiply(rgb, np.float32(1 / 255), dtype=np.float32)))
        blocks = view.blocks(self._grid, self.truncation_voxels)
        if self.bounds is not None:
            blocks = blocks[from_numpy(blocks_inside(blocks.numpy(), self.voxel_size, self.bounds, self.origin))]
        if blocks.shape[0] == 0:
            return False
        at_once = self._make_room(blocks)
        for begin in range(0, blocks.shape[0], at_once):
            self._grid.integrate(
                blocks[begin : begin + at_once],
                view.depth,
                rgb_image,
                view.K,
                view.K,
                view.camera_from_grid,
                1.0,
                FARTHEST,
                self.truncation_voxels,
            )
        self.n_integrated += 1
        return True

    def _make_room(self, blocks: o3d.core.Tensor) -> int:
        """Grow if necessary; the number of these blocks that may be integrated at once.

        Open3D counts every block as new. If its table could not hold them all, it copies the table to one of twice the
        size, which takes seconds and three times the memory, although most of the blocks exist.
        """
        table = self._grid.hashmap()
        n_most = table.capacity() if self.max_blocks is None else min(table.capacity(), self.max_blocks)
        if table.size() + blocks.shape[0] <= n_most:
            return int(blocks.shape[0])
        n_needed = int(table.size() + np.count_nonzero(~table.find(blocks)[1].numpy()))
        if self.max_blocks is not None and n_needed > self.max_blocks:
            raise VolumeTooLarge(n_needed)
        if n_needed + LEAST_ROOM > table.capacity():
            n_grown = int(np.ceil(n_needed * GROWTH))
            table.reserve(room_for(n_grown if self.max_blocks is None else min(n_grown, self.max_blocks)))
            self.n_grown += 1
        return int(table.capacity()) - n_needed

    def views_needed(self, min_views: int, least_views: int = 1) -> int:
        """Number of frames that must have measured a voxel of the surface; see `mesh`."""
        return min(max(min_views, least_views), max(least_views, self.n_integrated // 10))

    def mesh(self, min_views: int = 3, least_views: int = 1, release: bool = False) -> Mesh:
        """The surface inside the bounds; empty when nothing was fused.

        Args:
            min_views: frames that must have measured a voxel; at most a tenth of all frames, so that few views give a
                surface, too.
            least_views: lower bound on that. With 2, what a single frame with a wrong pose shows is removed.
            release: empty the volume after extraction, to free its memory.
        """
        if self.n_blocks == 0:
            return canonical(np.zeros((0, 3)), np.zeros((0, 3), np.int64), np.zeros((0, 3)))
        needed = self.views_needed(min_views, least_views)
        # Open3D keeps voxels whose weight is strictly above the threshold.
        extracted = self._grid.extract_triangle_mesh(needed - 0.5).cpu()
        if release:
            self._grid = _grid(self.voxel_size, 1)
        if "positions" not in extracted.vertex or len(extracted.vertex.positions) == 0:
            return canonical(np.zeros((0, 3)), np.zeros((0, 3), np.int64), np.zeros((0, 3)))
        vertices = extracted.vertex.positions.numpy() + np.float32(HALF_VOXEL * self.voxel_size)
        triangles = extracted.triangle.indices.numpy().astype(np.int64)
        colors = extracted.vertex.colors.numpy()
        if self.bounds is not None:
            lowest, highest = self.bounds - self.origin
            inside = ((vertices >= lowest) & (vertices <= highest)).all(axis=1)
            triangles = triangles[inside[triangles].all(axis=1)]
        mesh = canonical(vertices, triangles, colors)
        # In this order: rounding makes neighbours in it equal.
        return replace(mesh, vertices=(mesh.vertices + self.origin).astype(np.float32))


def canonical(vertices: Float[ndarray, "n 3"], triangles: Int[ndarray, "m 3"], colors: Float[ndarray, "n 3"]) -> Mesh:
    """The same surface in an order that depends on the surface alone; Open3D's depends on its threads.

    Vertices at one position are merged; triangles that lose their area by that and vertices of no triangle are removed;
    the rest is sorted, and a triangle begins with its lowest vertex, its winding kept.

    Args:
        colors: 0 to 1.
    """
    vertices = vertices.astype(np.float32) + np.float32(0)  # Adding zero turns -0.0 into 0.0, which has other bytes.
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

    A limit of 0 is ignored; with both 0 every frame is kept.

    Raises:
        ValueError: a limit is negative.
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


def touched_blocks(
    depth: Float32[ndarray, "h w"],
    K: Float[ndarray, "3 3"],
    world_from_camera: Float[ndarray, "4 4"],
    voxel_size: float,
    truncation_voxels: float = 5.0,
    origin: Float[ndarray, "3"] | None = None,
) -> Int32[ndarray, "n 3"]:
    """The voxel blocks that fusing a frame would touch; `origin` as for `Volume`."""
    view = _View.of(depth, K, world_from_camera, voxel_size, np.zeros(3) if origin is None else origin)
    if view is None:
        return np.zeros((0, 3), np.int32)
    return view.blocks(_grid(voxel_size, 1), truncation_voxels).numpy()


def blocks_inside(
    blocks: Int32[ndarray, "n 3"],
    voxel_size: float,
    bounds: Float[ndarray, "2 3"],
    origin: Float[ndarray, "3"] | None = None,
) -> Bool[ndarray, "n"]:
    """Blocks that intersect the bounds, widened by the one voxel that the surface at them depends on."""
    bounds = bounds if origin is None else bounds - origin
    lowest = (blocks * BLOCK_RESOLUTION + HALF_VOXEL) * voxel_size
    highest = lowest + BLOCK_RESOLUTION * voxel_size
    return ((highest > bounds[0] - voxel_size) & (lowest < bounds[1] + voxel_size)).all(axis=1)


def expected_blocks(touched: Sequence[Int32[ndarray, "_ 3"]], n_frames: int) -> int:
    """Number of voxel blocks that `n_frames` frames will touch, estimated from a sample of them.

    If the sample is all frames, it is the number of their blocks. Otherwise, many blocks seen once and few seen twice
    mean that many were not seen at all.

    Args:
        touched: blocks of each frame of the sample (`touched_blocks`), inside the bounds.

    Source: Chao et al. 2014, Ecological Monographs 84(1), extrapolation of incidence data from the Chao2 estimate.
    """
    if not touched:
        return 0
    _, n_seen = np.unique(np.concatenate(touched), axis=0, return_counts=True)
    m, q1, q2 = len(touched), int((n_seen == 1).sum()), int((n_seen == 2).sum())
    if q1 == 0 or m >= n_frames:
        return len(n_seen)
    q0 = (m - 1) / m * (q1**2 / (2 * q2) if q2 else q1 * (q1 - 1) / 2)
    if q0 == 0:
        return len(n_seen)
    return int(np.ceil(len(n_seen) + q0 * (1 - (1 - q1 / (m * q0 + q1)) ** (n_frames - m))))


def coarsening(blocks: Int32[ndarray, "n 3"], factor: float, truncation_voxels: float = 5.0) -> float:
    """Number of blocks with voxels `factor` times as large, as a share of the number of these.

    These are the larger blocks that contain them, and more, because the layer along the surface becomes thicker.
    """
    if len(blocks) == 0:
        return 1.0
    n_holding = len(np.unique(np.floor(blocks / factor).astype(np.int32), axis=0))
    thickness = 2 * truncation_voxels / BLOCK_RESOLUTION
    return n_holding / len(blocks) * (1 + thickness) / (1 + thickness / factor)


def room_for(n_blocks: int) -> int:
    """Capacity to reserve for an expected number of blocks."""
    return int(np.ceil(n_blocks * ROOM)) + LEAST_ROOM


MOST_BLOCKS = 1_000_000
"""Beyond some 1.05 million blocks (2^31 corners of voxels) Open3D's extraction overflows 32 bits and crashes the
process."""


def peak_bytes(n_blocks: int) -> int:
    """Peak memory of a volume with so many blocks, bytes, mesh extraction included."""
    return int(n_blocks * (ROOM * BLOCK_BYTES + EXTRACTION_BYTES))


@dataclass(frozen=True)
class _View:
    """A frame in Open3D's types."""

    depth: o3d.t.geometry.Image
    K: o3d.core.Tensor
    camera_from_grid: o3d.core.Tensor

    @staticmethod
    def of(
        depth: Float32[ndarray, "h w"],
        K: Float[ndarray, "3 3"],
        world_from_camera: Float[ndarray, "4 4"],
        voxel_size: float,
        origin: Float[ndarray, "3"],
    ) -> _View | None:
        """A frame; None without any measurement, for which Open3D would abort the process.

        Raises:
            ValueError: the transform is not rigid.
        """
        if fault := rigid_fault(world_from_camera):
            raise ValueError(f"world_from_camera: expected a rigid transform, got {fault}")
        if not (depth > 0).any():
            return None
        from_numpy = o3d.core.Tensor.from_numpy
        shift = np.array([[0, 0, HALF_PIXEL], [0, 0, HALF_PIXEL], [0, 0, 0]])
        world_from_grid = np.eye(4)
        world_from_grid[:3, 3] = origin + HALF_VOXEL * voxel_size
        return _View(
            o3d.t.geometry.Image(from_numpy(np.ascontiguousarray(depth))),
            from_numpy(K + shift),
            from_numpy(invert_rigid(world_from_camera) @ world_from_grid),
        )

    def blocks(self, grid: o3d.t.geometry.VoxelBlockGrid, truncation_voxels: float) -> o3d.core.Tensor:
        """Coordinates (n, 3) of the blocks near the measured surface; the grid's content does not matter."""
        try:
            return grid.compute_unique_block_coordinates(
                self.depth, self.K, self.camera_from_grid, 1.0, FARTHEST, truncation_voxels
            )
        except RuntimeError as error:
            # Open3D reads every fourth pixel, and raises an error if none of these has a measurement.
            if "No block is touched" not in str(error):
                raise
            return o3d.core.Tensor.empty((0, 3), o3d.core.int32)


def _grid(voxel_size: float, n_blocks: int) -> o3d.t.geometry.VoxelBlockGrid:
    float32 = o3d.core.float32
    return o3d.t.geometry.VoxelBlockGrid(
        ("tsdf", "weight", "color"),
        (float32, float32, float32),
        [o3d.core.SizeVector([n_channels]) for n_channels in (1, 1, 3)],
        voxel_size,
        BLOCK_RESOLUTION,
        n_blocks,
    )
