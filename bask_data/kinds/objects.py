"""Object instances: which vertex of a reconstruction belongs to which object."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from bask_data.artifact import Artifact, Metadata
from bask_data.kinds.arrays import read_all, start, write_array
from bask_data.specs import ArraySpec

if TYPE_CHECKING:
    import numpy as np


class InstanceRow(Metadata):
    """One object.

    Args:
        area_m2: surface area, square metres.
        centroid: mean vertex, metres, world frame.
        extents: size of the axis-aligned box in the world frame, metres.
        concave_share: share of its surface that is more than 1 cm inside its convex hull: close to 0 for a box or a
            can; 0.25 or more for a hollow object, or several objects that touch.
    """

    id: int
    name: str = ""
    n_vertices: int
    area_m2: float
    centroid: tuple[float, float, float]
    extents: tuple[float, float, float]
    concave_share: float = 0.0


class PlaneRow(Metadata):
    """A plane of the background: the support, or structure such as the wall of a bin.

    Args:
        plane: nx, ny, nz, d in the world frame, metres: n.x + d = 0, n towards the cameras.
        area_m2: area of the surface on it, square metres.
        noise_m: standard deviation of that surface about the plane, metres.
    """

    role: Literal["support", "structure"]
    plane: tuple[float, float, float, float]
    area_m2: float
    noise_m: float


class NeighbourRow(Metadata):
    """Two objects that nearly touch: with twice the gap allowed within an object, they would be one.

    Args:
        a, b: ids of the objects.
        gap_m: distance between their surfaces, metres.
    """

    a: int
    b: int
    gap_m: float


class ObjectsMetadata(Metadata):
    """The objects, largest first; planes of the background, the support plane first; pairs of objects that nearly
    touch; warnings for the user."""

    instances: list[InstanceRow]
    planes: list[PlaneRow] = []
    neighbours: list[NeighbourRow] = []
    warnings: list[str] = []


class ObjectInstances(Artifact):
    """The objects of a scene."""

    kind = "objects"
    scope = "scene"
    schema_version = 2
    metadata_model = ObjectsMetadata
    arrays = {
        "vertex_instance": ArraySpec(
            ("n",), "int32", "Instance of each vertex of the reconstruction; 0 is background, 1..k are objects."
        ),
        "support_plane": ArraySpec(
            ("4",),
            "float64",
            "Plane nx, ny, nz, d in the world frame: n.x + d = 0, n towards the objects; zeros: no plane.",
        ),
    }

    @cached_property
    def vertex_instance(self) -> np.ndarray:
        """Instance of each vertex (n,) int32; 0 is background."""
        return read_all(self.group, "vertex_instance", self.path)

    @cached_property
    def support_plane(self) -> np.ndarray:
        """Support plane (4,) float64: n.x + d = 0, metres, world frame; zeros if there is none."""
        return read_all(self.group, "support_plane", self.path)

    @property
    def instances(self) -> list[InstanceRow]:
        """The objects, in the order of their ids."""
        return self.metadata.instances

    @staticmethod
    def write(
        out: Path,
        *,
        vertex_instance: np.ndarray,
        support_plane: np.ndarray,
        instances: list[InstanceRow],
        warnings: list[str],
        planes: Sequence[PlaneRow] = (),
        neighbours: Sequence[NeighbourRow] = (),
    ) -> None:
        """Write the instances of all vertices, the objects, planes, neighbours and warnings."""
        metadata = {
            "instances": [row.model_dump() for row in instances],
            "planes": [row.model_dump() for row in planes],
            "neighbours": [row.model_dump() for row in neighbours],
            "warnings": warnings,
        }
        group = start(out, ObjectInstances, metadata)
        write_array(group, ObjectInstances, "vertex_instance", vertex_instance)
        write_array(group, ObjectInstances, "support_plane", support_plane)
