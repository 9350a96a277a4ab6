"""A mesh with an instance at every vertex, ready for rays."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float32, Int32, UInt8
from numpy import ndarray
from scipy.spatial import ConvexHull, QhullError

from bask_data.core.geometry import invert_rigid, project, transform
from bask_data.core.visibility.decision import EDGE_REACH
from bask_data.core.visibility.surface import Hits, Surface

MAX_INSTANCES = 255
"""Label images are 8-bit."""

MARGIN = 1 + EDGE_REACH
"""Pixels cast around an object's outline, so that the edges can be set right from both sides."""

N_AMODAL_RAYS = 10_000
"""Rays cast to find how much of an instance is hidden; more than that would make a share no more telling."""

NO_VERTEX = np.int32(-1)

MIXED = np.uint16(1000)
"""Stands for the label of a triangle whose corners differ."""


class LabelledSurface:
    """A mesh with an instance at every vertex, ready for rays.

    Args:
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
            # Rays hit every triangle that has a corner of the instance, so its outline has to hold those too.
            near = triangles[(self._corner_label == label).any(axis=1)]
            self._outlines.append(_hull(vertices[np.unique(near)]))
            self._alone.append(Surface(vertices, own) if len(own) else None)

    def cast(self, rays: Float32[ndarray, "n 6"]) -> tuple[Float32[ndarray, "n"], UInt8[ndarray, "n"]]:
        """Ray parameter of the first hit (infinity: none), and the instance there, of rays (origin, direction).

        A triangle that two instances share is divided between them: the hit takes the label of the nearest corner.
        """
        hits = self._surface.cast(rays)
        return hits.distance, self._label_of(hits)

    def cast_to_vertices(
        self, rays: Float32[ndarray, "n 6"]
    ) -> tuple[Float32[ndarray, "n"], UInt8[ndarray, "n"], Int32[ndarray, "n"]]:
        """As `cast`, and a vertex of the triangle hit; `NO_VERTEX` for none."""
        hits = self._surface.cast(rays)
        i_triangle = hits.triangle
        some = i_triangle < len(self._triangles)
        i_vertex = np.where(some, self._triangles[np.where(some, i_triangle, 0), 0], NO_VERTEX)
        return hits.distance, self._label_of(hits), i_vertex

    def _label_of(self, hits: Hits) -> UInt8[ndarray, "n"]:
        # What misses has the largest index there is; it becomes the one after the last triangle, which is background.
        i_triangle = np.minimum(hits.triangle, np.uint32(len(self._corner_label)))
        label = self._triangle_label[i_triangle]
        mixed = np.flatnonzero(label == MIXED)
        corners = self._corner_label[i_triangle[mixed]]
        second_third = hits.corner_weights[mixed]
        weights = np.column_stack([1 - second_third.sum(axis=1), second_third])
        label[mixed] = corners[np.arange(len(mixed)), weights.argmax(axis=1)]
        return label.astype(np.uint8)

    def n_meeting(self, instance: int, rays: Float32[ndarray, "n 6"]) -> float:
        """Number of rays that would hit an instance if there were nothing else; of very many, estimated by some."""
        alone = self._alone[instance - 1]
        step = max(1, -(-len(rays) // N_AMODAL_RAYS))
        if alone is None or len(rays) == 0:
            return 0.0
        some = np.ascontiguousarray(rays[::step])
        return float(alone.meets(some).mean() * len(rays))

    def box(
        self,
        instance: int,
        K: Float[ndarray, "3 3"],
        world_from_camera: Float[ndarray, "4 4"],
        height: int,
        width: int,
    ) -> tuple[slice, slice]:
        """Rows and columns that hold the image of an instance with a margin; empty when it is out of view."""
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
