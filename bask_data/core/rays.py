"""Meshes that rays are cast against."""

from __future__ import annotations

import numpy as np
import open3d as o3d
from jaxtyping import Float32, Int
from numpy import ndarray


def ray_scene(vertices: Float32[ndarray, "n 3"], triangles: Int[ndarray, "m 3"]) -> o3d.t.geometry.RaycastingScene:
    """A mesh ready for rays, whose hits name triangles by their row."""
    scene, tensor = o3d.t.geometry.RaycastingScene(), o3d.core.Tensor.from_numpy
    scene.add_triangles(
        tensor(np.ascontiguousarray(vertices)), tensor(np.ascontiguousarray(triangles, dtype=np.uint32))
    )
    return scene
