"""A mesh with an instance at every vertex, ready for rays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Int32, UInt8
from numba import njit
from numpy import ndarray
from scipy.spatial import ConvexHull, QhullError

from bask_data.core.compiled import compiled
from bask_data.core.geometry import invert_rigid, project, transform
from bask_data.core.visibility.decision import EDGE_REACH
from bask_data.core.visibility.surface import Hits, Surface

MAX_INSTANCES = 255
"""Label images are 8-bit."""

MARGIN = 1 + EDGE_REACH
"""Pixels around an object's outline for which rays are cast, so that edges can be corrected from both sides."""

N_AMODAL_RAYS = 10_000
"""Most rays cast to estimate the hidden share of an instance. Chosen, sensitivity not measured."""

NO_VERTEX = np.int32(-1)
"""Stands for the vertex of a ray that hits nothing."""

MIXED = np.uint16(1000)
"""Stands for the label of a triangle whose corners differ."""


@dataclass(frozen=True)
class LabelledImage:
    """The first hits of the rays through an image's pixels.

    Args:
        depth: z-depth, metres; infinity for nothing.
        instance: instance there; 0 for background and for nothing.
        i_vertex: a vertex of the triangle hit; `NO_VERTEX` for nothing.
    """

    depth: Float32[ndarray, "h w"]
    instance: UInt8[ndarray, "h w"]
    i_vertex: Int32[ndarray, "h w"]


class LabelledSurface:
    """A mesh with an instance at every vertex, ready for rays.

    Args:
        vertices: metres, world frame.
        triangles: rows of `vertices`.
        vertex_instance: 0 is background, 1..`n_instances` are objects.

    Raises:
        ValueError: there is no triangle, or a label is out of range.
    """

    def __init__(
        self,
        vertices: Float32[ndarray, "n 3"],
        triangles: Int32[ndarray, "m 3"],
        vertex_instance: Int32[ndarray, "n"],
        n_instances: int,
        colors: UInt8[ndarray, "n 3"] | None = None,
    ) -> None:
        if len(triangles) == 0:
            raise ValueError("triangles: expected at least one, got none")
        if n_instances > MAX_INSTANCES:
            raise ValueError(f"n_instances: expected at most {MAX_INSTANCES}, got {n_instances}")
        if vertex_instance.min() < 0 or vertex_instance.max() > n_instances:
            raise ValueError(
                f"vertex_instance: expected 0..{n_instances}, got {vertex_instance.min()}..{vertex_instance.max()}"
            )
        self.n_instances = n_instances
        self.colors = colors
        self._triangles = triangles
        self._surface = Surface(vertices, triangles)
        self._corner_label = vertex_instance[triangles].astype(np.uint8)
        majority = _majority(self._corner_label)
        uniform = (self._corner_label == self._corner_label[:, :1]).all(axis=1)
        self._triangle_label = np.append(np.where(uniform, majority.astype(np.uint16), MIXED), np.uint16(0))
        self._outlines: list[Float[ndarray, "_ 3"]] = []
        self._alone: list[Surface | None] = []
        for label in range(1, n_instances + 1):
            own = triangles[majority == label]
            # A ray can get the instance from any triangle with a corner of it, so the outline has to hold these, too.
            near = triangles[(self._corner_label == label).any(axis=1)]
            self._outlines.append(_hull(vertices[np.unique(near)]))
            self._alone.append(Surface(vertices, own) if len(own) else None)

    def cast(self, rays: Float32[ndarray, "n 6"]) -> tuple[Float32[ndarray, "n"], UInt8[ndarray, "n"]]:
        """Ray parameter of the first hit (infinity: none), and the instance there, of rays (origin, direction).

        A triangle that two instances share is divided between them: the hit takes the label of the nearest corner.
        """
        hits = self._surface.cast(rays)
        return hits.distance, self._label_of(hits)

    def image(self, rays: Float32[ndarray, "n 6"], region: Bool[ndarray, "h w"]) -> LabelledImage:
        """The first hits of rays, as an image.

        Args:
            rays: of the pixels of `region`, row by row.
        """
        hits = self._surface.cast(rays)
        return LabelledImage(
            *_image(
                region,
                hits.distance,
                hits.triangle,
                hits.corner_weights,
                self._triangle_label,
                self._corner_label,
                self._triangles,
            )
        )

    def _label_of(self, hits: Hits) -> UInt8[ndarray, "n"]:
        labels: UInt8[ndarray, "n"] = _labels(
            hits.triangle, hits.corner_weights, self._triangle_label, self._corner_label
        )
        return labels

    def share_meeting(self, instance: int, rays: Float32[ndarray, "n 6"]) -> float:
        """Share of rays that would hit an instance if there were nothing else; 0 without rays."""
        alone = self._alone[instance - 1]
        if alone is None or len(rays) == 0:
            return 0.0
        return float(alone.meets(rays).mean())

    def box(
        self,
        instance: int,
        K: Float[ndarray, "3 3"],
        world_from_camera: Float[ndarray, "4 4"],
        height: int,
        width: int,
    ) -> tuple[slice, slice]:
        """Rows and columns of the image of an instance, with a margin; empty when it is out of view."""
        points = transform(invert_rigid(world_from_camera), self._outlines[instance - 1])
        if len(points) == 0 or (points[:, 2] <= 0).all():
            return slice(0, 0), slice(0, 0)
        if (points[:, 2] <= 1e-3).any():  # What reaches behind the camera has no bounded image.
            return slice(0, height), slice(0, width)
        uv, _ = project(points, K)
        (left, top), (right, bottom) = np.floor(uv.min(axis=0)) - MARGIN, np.ceil(uv.max(axis=0)) + MARGIN + 1
        rows = slice(int(np.clip(top, 0, height)), int(np.clip(bottom, 0, height)))
        columns = slice(int(np.clip(left, 0, width)), int(np.clip(right, 0, width)))
        return rows, columns


@njit(inline="always")
def _label_at(i_triangle, second, third, triangle_label, corner_label):  # type: ignore[no-untyped-def]
    """The label of a triangle, or of its nearest corner where they differ; the first of equally near ones."""
    label = triangle_label[i_triangle]
    if label == MIXED:
        first = np.float32(1) - (second + third)
        label = corner_label[i_triangle, 0]
        if second > first or third > first:
            label = corner_label[i_triangle, 2] if third > second else corner_label[i_triangle, 1]
    return np.uint8(label)


@compiled
def _labels(triangle, corner_weights, triangle_label, corner_label):  # type: ignore[no-untyped-def]
    """The label of each hit (n,)."""
    label = np.empty(len(triangle), np.uint8)
    for i in range(len(triangle)):
        # A miss has the largest index there is; it becomes the one after the last triangle, which is background.
        hit = min(np.int64(triangle[i]), len(corner_label))
        label[i] = _label_at(hit, corner_weights[i, 0], corner_weights[i, 1], triangle_label, corner_label)
    return label


@compiled
def _image(  # type: ignore[no-untyped-def]
    region, distance, triangle, corner_weights, triangle_label, corner_label, corners
):
    """Depth, label and vertex (h, w) of the hits of a region's rays, in one pass."""
    height, width = region.shape
    depth, label = np.empty((height, width), np.float32), np.empty((height, width), np.uint8)
    i_vertex = np.empty((height, width), np.int32)
    n_triangles, i = len(corner_label), 0
    for v in range(height):
        for u in range(width):
            depth[v, u], label[v, u], i_vertex[v, u] = np.inf, 0, NO_VERTEX
            if not region[v, u]:
                continue
            hit = np.int64(triangle[i])
            if hit < n_triangles:
                depth[v, u], i_vertex[v, u] = distance[i], corners[hit, 0]
                label[v, u] = _label_at(hit, corner_weights[i, 0], corner_weights[i, 1], triangle_label, corner_label)
            i += 1
    return depth, label, i_vertex


def _majority(corner_label: UInt8[ndarray, "m 3"]) -> UInt8[ndarray, "m"]:
    """The label of two corners or more; the first corner's when all differ."""
    first, second, third = corner_label.T
    return np.where(second == third, second, first)


def _hull(points: Float32[ndarray, "n 3"]) -> Float[ndarray, "_ 3"]:
    """Points whose projections bound those of all of them."""
    points = points.astype(np.float64)
    try:
        return points[ConvexHull(points).vertices]
    except (QhullError, ValueError):  # Too few points, or all in a plane.
        return points
