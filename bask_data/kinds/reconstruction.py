"""Reconstructions: the surface of a scene as a triangle mesh."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from bask_data.artifact import REMAKE, Artifact, Metadata
from bask_data.errors import BadData
from bask_data.kinds.arrays import read_all, start, write_array
from bask_data.kinds.tables import read_table, write_table
from bask_data.specs import ArraySpec, TableSpec

if TYPE_CHECKING:
    import numpy as np
    import pyarrow as pa

    from bask_data.core.tsdf import Mesh


class FrameRow(Metadata):
    """One frame of the scan: whether it was fused, and how well the mesh explains its depth.

    Args:
        fused: whether it is part of the mesh.
        suspect: whether the mesh explains it far worse than the other frames.
        valid_depth: share of its pixels with a measurement within the fused range.
        n_judged: number of its rays that were compared with the mesh.
        explained: share of these whose measurement lies on the mesh.
        residual: median of measured minus mesh depth, metres.
        residual_abs: median of its magnitude, metres.
        from_behind: share of its rays that hit the back of a surface, of those that hit the mesh.
    """

    camera: str
    frame: int
    fused: bool
    suspect: bool = False
    valid_depth: float
    n_judged: int
    explained: float
    residual: float
    residual_abs: float
    from_behind: float


class UnmeasuredRegion(Metadata):
    """A region that many views from several sides failed to measure: something transparent, shiny or black.

    Args:
        centre: centre of its axis-aligned box in the world frame, metres.
        size: size of that box, metres.
        volume: cubic metres.
    """

    centre: tuple[float, float, float]
    size: tuple[float, float, float]
    volume: float


class Quality(Metadata):
    """Figures of the fusion. Lengths are metres; None where nothing could be compared.

    Args:
        frames: frames in the scan.
        frames_excluded: frames excluded by name.
        frames_of_distinct_views: frames left after thinning.
        frames_fused: frames of these that are part of the mesh.
        frames_without_depth: frames without any measurement within the range.
        frames_without_depth_in_the_workspace: frames with measurements only elsewhere, or without depth.
        frames_suspect: frames that the mesh explains far worse than the others, whether fused or not.
        workspace: whether the box was given or estimated.
        voxel_blocks: number of blocks of the volume.
        explained: share of the measurements in the workspace that lie on the mesh.
        residual: median over the frames of measured minus mesh depth.
        residual_abs: median over the frames of its magnitude.
        seen_from_behind: share of the visible surface that no camera saw from the front.
    """

    frames: int = 0
    frames_excluded: int = 0
    frames_of_distinct_views: int = 0
    frames_fused: int = 0
    frames_without_depth: int = 0
    frames_without_depth_in_the_workspace: int = 0
    frames_suspect: int = 0
    workspace: Literal["given", "estimated"] = "estimated"
    voxel_blocks: int = 0
    explained: float | None = None
    residual: float | None = None
    residual_abs: float | None = None
    seen_from_behind: float | None = None


class ReconstructionMetadata(Metadata):
    """How the mesh was made, and how well it explains the frames.

    Args:
        voxel_size: metres.
        bounds: the workspace box (x_min, y_min, z_min, x_max, y_max, z_max), metres, world frame; given or estimated.
        unmeasured: regions with something that depth cameras cannot measure.
        warnings: warnings for the user.
    """

    voxel_size: float
    bounds: tuple[float, float, float, float, float, float]
    quality: Quality = Quality()
    unmeasured: list[UnmeasuredRegion] = []
    warnings: list[str] = []


class Reconstruction(Artifact):
    """The fused surface of a scan."""

    kind = "reconstruction"
    scope = "scene"
    schema_version = 2
    metadata_model = ReconstructionMetadata
    arrays = {
        "vertices": ArraySpec(("n", "3"), "float32", "Positions in the world frame.", "metre"),
        "triangles": ArraySpec(("m", "3"), "int32", "Vertex indices, counter-clockwise seen from outside."),
        "colors": ArraySpec(("n", "3"), "uint8", "Colour of each vertex, red, green, blue."),
    }
    tables = {
        "frames.parquet": TableSpec(
            {
                "camera": ("string", "camera of the frame"),
                "frame": ("int32", "number of the frame"),
                "fused": ("bool", "whether the frame is part of the mesh"),
                "suspect": ("bool", "whether the mesh explains the frame far worse than the others"),
                "valid_depth": ("float32", "share of the pixels with a measurement within the range fused"),
                "n_judged": ("int32", "rays of the frame that were held against the mesh"),
                "explained": ("float32", "share of those whose measurement lies on the mesh; NaN: none"),
                "residual": ("float32", "median of measured minus mesh depth, metres; NaN: none"),
                "residual_abs": ("float32", "median of its magnitude, metres; NaN: none"),
                "from_behind": ("float32", "share of the rays onto the mesh that meet its back; NaN: none"),
            }
        )
    }
    files = {"mesh.ply": "the same mesh, binary PLY, for other tools"}

    @cached_property
    def vertices(self) -> np.ndarray:
        """Vertices (n, 3) float32, metres, world frame."""
        return read_all(self.group, "vertices", self.path)

    @cached_property
    def triangles(self) -> np.ndarray:
        """Triangles (m, 3) int32, indices of vertices; `BadData` if one is out of range."""
        triangles = read_all(self.group, "triangles", self.path)
        n_vertices = len(self.vertices)
        if triangles.size and (triangles.min() < 0 or triangles.max() >= n_vertices):
            expected, got = f"indices below {n_vertices}", str(triangles.max())
            raise BadData(self.path, "triangles", expected=expected, got=got, fix=REMAKE)
        return triangles

    @cached_property
    def colors(self) -> np.ndarray:
        """Colours of the vertices (n, 3) uint8, RGB."""
        return read_all(self.group, "colors", self.path)

    @property
    def voxel_size(self) -> float:
        """Voxel size, metres."""
        return self.metadata.voxel_size

    @cached_property
    def frames(self) -> pa.Table:
        """A row (`FrameRow`) for each frame of the scan that was not excluded."""
        return read_table(self, "frames.parquet")

    @staticmethod
    def write(
        out: Path,
        mesh: Mesh,
        *,
        voxel_size: float,
        bounds: tuple[float, float, float, float, float, float],
        quality: Quality | None = None,
        frames: Sequence[FrameRow] = (),
        unmeasured: Sequence[UnmeasuredRegion] = (),
        warnings: Sequence[str] = (),
    ) -> None:
        """Write the mesh as arrays and as `mesh.ply`, and its quality."""
        metadata = ReconstructionMetadata(
            voxel_size=voxel_size,
            bounds=bounds,
            quality=quality or Quality(),
            unmeasured=list(unmeasured),
            warnings=list(warnings),
        )
        group = start(out, Reconstruction, metadata.model_dump(mode="json"))
        write_array(group, Reconstruction, "vertices", mesh.vertices)
        write_array(group, Reconstruction, "triangles", mesh.triangles)
        write_array(group, Reconstruction, "colors", mesh.colors)
        _write_ply(out / "mesh.ply", mesh.vertices, mesh.triangles, mesh.colors)
        names = Reconstruction.tables["frames.parquet"].columns
        columns = {name: [getattr(row, name) for row in frames] for name in names}
        write_table(out, Reconstruction, "frames.parquet", columns)


def _write_ply(file: Path, vertices: np.ndarray, triangles: np.ndarray, colors: np.ndarray) -> None:
    """Write a binary PLY. Open3D's writer is not used, as it reports success on a full disk."""
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
