"""Reconstructions: the surface of a scene as a triangle mesh."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from bask_data.artifact import ArraySpec, Artifact, Metadata
from bask_data.errors import BadData
from bask_data.kinds.arrays import read_all, start, write_array

if TYPE_CHECKING:
    import numpy as np


class ReconstructionMetadata(Metadata):
    """How the mesh was made, and how well it explains the frames.

    Args:
        voxel_size: metres.
        bounds: the workspace box (x_min, y_min, z_min, x_max, y_max, z_max), metres, world frame; given or estimated.
        quality: figures of the fusion by name, as the stage documents them.
    """

    voxel_size: float
    bounds: tuple[float, float, float, float, float, float]
    quality: dict[str, float | int | str | list[float] | None] = {}


class Reconstruction(Artifact):
    """The fused surface of a scan."""

    kind = "reconstruction"
    scope = "scene"
    metadata_model = ReconstructionMetadata
    arrays = {
        "vertices": ArraySpec(("n", "3"), "float32", "Positions in the world frame.", "metre"),
        "triangles": ArraySpec(("m", "3"), "int32", "Vertex indices, counter-clockwise seen from outside."),
        "colors": ArraySpec(("n", "3"), "uint8", "Colour of each vertex, red, green, blue."),
    }
    files = {"mesh.ply": "the same mesh, binary PLY, for other tools"}

    @cached_property
    def vertices(self) -> np.ndarray:
        """(n, 3) float32, metres, world frame."""
        return read_all(self.group, "vertices", self.path)

    @cached_property
    def triangles(self) -> np.ndarray:
        """(m, 3) int32 indices of vertices."""
        triangles = read_all(self.group, "triangles", self.path)
        n_vertices = len(self.vertices)
        if triangles.size and (triangles.min() < 0 or triangles.max() >= n_vertices):
            raise BadData(self.path, "triangles", expected=f"indices below {n_vertices}", got=str(triangles.max()))
        return triangles

    @cached_property
    def colors(self) -> np.ndarray:
        """(n, 3) uint8."""
        return read_all(self.group, "colors", self.path)

    @property
    def voxel_size(self) -> float:
        """Metres."""
        return self.metadata.voxel_size

    @staticmethod
    def write(
        out: Path,
        *,
        vertices: np.ndarray,
        triangles: np.ndarray,
        colors: np.ndarray,
        voxel_size: float,
        bounds: tuple[float, float, float, float, float, float],
        quality: dict[str, float | int | str | list[float] | None],
    ) -> None:
        """Write the mesh as arrays and as `mesh.ply`."""
        group = start(out, Reconstruction, {"voxel_size": voxel_size, "bounds": bounds, "quality": quality})
        write_array(group, Reconstruction, "vertices", vertices)
        write_array(group, Reconstruction, "triangles", triangles)
        write_array(group, Reconstruction, "colors", colors)
        _write_ply(out / "mesh.ply", vertices, triangles, colors)


def _write_ply(file: Path, vertices: np.ndarray, triangles: np.ndarray, colors: np.ndarray) -> None:
    """A binary PLY. Written here because Open3D's writer reports success on a full disk."""
    import numpy as np

    header = (
        "ply\nformat binary_little_endian 1.0\n"
        f"element vertex {len(vertices)}\nproperty float x\nproperty float y\nproperty float z\n"
        "property uchar red\nproperty uchar green\nproperty uchar blue\n"
        f"element face {len(triangles)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    points = np.empty(len(vertices), dtype=[("xyz", "<f4", 3), ("rgb", "u1", 3)])
    points["xyz"], points["rgb"] = vertices, colors
    faces = np.empty(len(triangles), dtype=[("n", "u1"), ("ijk", "<i4", 3)])
    faces["n"], faces["ijk"] = 3, triangles
    with file.open("wb") as stream:
        stream.write(header.encode())
        stream.write(points.tobytes())
        stream.write(faces.tobytes())
