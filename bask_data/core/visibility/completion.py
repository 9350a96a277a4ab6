"""Space that may be solid although no image measured it: the convex hull of an object, less what was seen through.

Sensors return nothing on dark, shiny or oblique surfaces, so a fused mesh has holes there. Nothing is filled where
measurements passed: the hole in a mug's handle stays open, because the table was measured through it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, Int32, UInt8
from numpy import ndarray
from scipy.spatial import ConvexHull, QhullError

from bask_data.core.geometry import in_image, invert_rigid, project, transform
from bask_data.core.visibility.surface import Surface

N_CELLS = 48
"""Most cells along the longest side of an object. Chosen, sensitivity not measured."""

SMALLEST_CELL = 0.003
"""Metres; assumes a tabletop and a sensor with a few millimetres of noise. Chosen, sensitivity not measured."""

N_TRIED = 2000
"""Vertices tested to judge how convex an object is. Chosen, sensitivity not measured."""

INSET = 1.0
"""Cells inside the hull from which unmeasured space is filled: the outermost vertices, which span the hull, are where
noise put them. Chosen, sensitivity not measured."""

DEEP = 1 / 8
"""Share of an object's length inside the hull from which a vertex counts as evidence against a convex shape. Chosen,
sensitivity not measured."""

MOST_DEEP = 0.05
"""Largest share of such vertices. A full crate, or several objects that were not separated, have more; their hull spans
air that a sensor's shadow hides from every frame, and is not filled. Chosen, sensitivity not measured."""

SEEN_THROUGH = 2
"""Frames that must have measured beyond a cell: a single one may be a reflection. Chosen, sensitivity not measured."""


@dataclass
class _Block:
    """The cells in and around one instance's hull."""

    instance: int
    lowest: Float[ndarray, "3"]
    cell: float
    shape: tuple[int, int, int]
    index: Int[ndarray, "n 3"]
    centres_world: Float[ndarray, "n 3"]
    outside: Float[ndarray, "n"]
    """Metres from the hull; negative inside it."""
    n_through: Int32[ndarray, "n"]
    n_on: Int32[ndarray, "n"]


class Completion:
    """The hulls of all instances: carved frame by frame (`carve`), then queried for the pixels they fill.

    Args:
        reach: metres around a hull within which a measured point may still be the object's.
    """

    def __init__(self, vertices: Float32[ndarray, "n 3"], vertex_instance: Int32[ndarray, "n"], reach: float) -> None:
        self._blocks: list[_Block] = []
        for instance in np.unique(vertex_instance[vertex_instance > 0]):
            block = _block(vertices[vertex_instance == instance].astype(np.float64), int(instance), reach)
            if block is not None:
                self._blocks.append(block)
        self._surface: Surface | None = None
        self._face_label = np.zeros(0, np.uint8)
        self._allowed: list[Bool[ndarray, "nx ny nz"]] = []

    def carve(
        self,
        depth: Float32[ndarray, "h w"],
        K: Float[ndarray, "3 3"],
        world_from_camera: Float[ndarray, "4 4"],
        tolerance: tuple[float, float],
    ) -> None:
        """Count the cells that a frame measured through, and those in which it measured a surface."""
        for block in self._blocks:
            uv, z = project(transform(invert_rigid(world_from_camera), block.centres_world), K)
            seen = np.flatnonzero(in_image(uv, *depth.shape))
            u, v = np.rint(uv[seen]).astype(int).T
            measured = depth[v, u]
            slack = tolerance[0] + tolerance[1] * z[seen] + block.cell
            block.n_through[seen] += measured > z[seen] + slack
            block.n_on[seen] += (measured > 0) & (np.abs(measured - z[seen]) <= slack)

    def finish(self) -> None:
        """End carving; required before `hit` and `holds`."""
        parts, labels = [], []
        self._allowed = []
        for block in self._blocks:
            solid = ~((block.n_through >= SEEN_THROUGH) & (block.n_through > block.n_on))
            self._allowed.append(_grid(block, solid))
            parts.append(_faces(_grid(block, solid & (block.outside <= -INSET * block.cell)), block))
            labels.append(np.full(len(parts[-1][1]), block.instance, np.uint8))
        self._face_label = np.concatenate([*labels, np.zeros(1, np.uint8)])
        start = np.cumsum([0, *(len(points) for points, _ in parts)])
        triangles = [faces + begin for (_, faces), begin in zip(parts, start[:-1], strict=True)]
        if len(self._face_label) > 1:
            vertices = np.concatenate([points for points, _ in parts]).astype(np.float32)
            self._surface = Surface(vertices, np.concatenate(triangles))

    def hit(self, rays: Float32[ndarray, "n 6"]) -> tuple[Float32[ndarray, "n"], UInt8[ndarray, "n"]]:
        """Ray parameter of the first cell that may be solid (infinity: none), and its instance (0: none)."""
        if self._surface is None or len(rays) == 0:
            return np.full(len(rays), np.inf, np.float32), np.zeros(len(rays), np.uint8)
        hits = self._surface.cast(np.ascontiguousarray(rays))
        i_face = np.minimum(hits.triangle, np.uint32(len(self._face_label) - 1))
        return hits.distance, self._face_label[i_face]

    def holds(self, points_world: Float32[ndarray, "n 3"]) -> UInt8[ndarray, "n"]:
        """The instance whose hull, widened by the reach, holds each point, unless it was seen through; 0: none."""
        label = np.zeros(len(points_world), np.uint8)
        for block, allowed in zip(self._blocks, self._allowed, strict=True):
            index = np.floor((points_world - block.lowest) / block.cell).astype(int)
            near = np.flatnonzero(((index >= 0) & (index < block.shape)).all(axis=1) & (label == 0))
            inside = near[allowed[tuple(index[near].T)]]
            label[inside] = block.instance
        return label


def _block(points: Float[ndarray, "n 3"], instance: int, reach: float) -> _Block | None:
    """The cells of an instance; None where its points enclose no volume or are far from a convex shape."""
    if len(points) < 4:
        return None
    try:
        hull = ConvexHull(points)
    except QhullError:
        return None
    # Neighbouring triangles of a face have the same plane; each plane once.
    planes = np.unique(np.round(hull.equations, 6), axis=0)
    length = float(np.ptp(points, axis=0).max())
    sample = points[:: max(1, len(points) // N_TRIED)]
    if (_outside(sample, planes) < -DEEP * length).mean() > MOST_DEEP:
        return None
    cell = max(SMALLEST_CELL, length / N_CELLS)
    lowest = points.min(axis=0) - reach - cell
    n_x, n_y, n_z = np.ceil((points.max(axis=0) + reach + cell - lowest) / cell).astype(int).tolist()
    index = np.stack(np.meshgrid(np.arange(n_x), np.arange(n_y), np.arange(n_z), indexing="ij"), axis=-1).reshape(-1, 3)
    centres = lowest + (index + 0.5) * cell
    outside = _outside(centres, planes)
    near = outside <= reach
    n_near = int(near.sum())
    return _Block(
        instance=instance,
        lowest=lowest,
        cell=cell,
        shape=(n_x, n_y, n_z),
        index=index[near],
        centres_world=centres[near],
        outside=outside[near],
        n_through=np.zeros(n_near, np.int32),
        n_on=np.zeros(n_near, np.int32),
    )


def _outside(points: Float[ndarray, "n 3"], planes: Float[ndarray, "m 4"]) -> Float[ndarray, "n"]:
    """Distance from a hull given by its planes, metres; negative inside."""
    outside = np.full(len(points), -np.inf)
    for plane in planes:
        np.maximum(outside, points @ plane[:3] + plane[3], out=outside)
    return outside


def _grid(block: _Block, chosen: Bool[ndarray, "n"]) -> Bool[ndarray, "nx ny nz"]:
    grid = np.zeros(block.shape, bool)
    grid[tuple(block.index[chosen].T)] = True
    return grid


def _faces(solid: Bool[ndarray, "nx ny nz"], block: _Block) -> tuple[Float[ndarray, "n 3"], Int[ndarray, "m 3"]]:
    """Two triangles for each side of a solid cell whose neighbour is not solid."""
    padded = np.pad(solid, 1)
    corners = []
    for axis in range(3):
        along, across = np.eye(3, dtype=int)[[(axis + 1) % 3, (axis + 2) % 3]]
        boundary = np.argwhere(np.diff(padded.astype(np.int8), axis=axis)) - 1
        boundary[:, axis] += 1
        corners.append(boundary[:, None] + np.stack([0 * along, along, along + across, across]))
    quads = np.concatenate(corners)
    first = 4 * np.arange(len(quads))[:, None]
    triangles = np.concatenate([first + np.array([0, 1, 2]), first + np.array([0, 2, 3])])
    return block.lowest + quads.reshape(-1, 3) * block.cell, triangles
