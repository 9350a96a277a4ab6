"""Object instances: which vertex of a reconstruction belongs to which object."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from bask_data.artifact import Artifact, Metadata
from bask_data.findings import Finding
from bask_data.kinds.arrays import read_all, start, write_array
from bask_data.specs import ArraySpec

if TYPE_CHECKING:
    import numpy as np


Flag = Literal["cut", "floating", "with-camera", "flat"]
"""Why something found may not be an object of its own on the support: cut by the border of what was seen; nothing
below it down to the support; there in few frames only, as what moves with the camera is; flat on the support."""

FLAG_TEXTS: dict[Flag, str] = {
    "cut": "cut by the border of what was seen",
    "floating": "not standing on the support",
    "with-camera": "fixed to the camera, or moved: most frames see through it",
    "flat": "flat on the support",
}
"""Each flag in words."""

ONE_SIDE = 0.75
"""Share of an object's closed surface below which it was seen from one side only. A box seen from one viewpoint shows
two or three of its five faces, and the hull of what was seen closes it behind. Chosen, sensitivity not measured."""


class InstanceRow(Metadata):
    """One object.

    Args:
        area_m2: surface area, square metres.
        centroid: mean vertex, metres, world frame.
        extents: size of the axis-aligned box in the world frame, metres.
        concave_share: share of its surface that is more than 1 cm inside its convex hull: close to 0 for a box or a
            can; 0.25 or more for a hollow object, or several objects that touch.
        seen: share of its closed surface, without the underside, that was seen: about 0.5 from one side, 1 all around;
            None in artifacts made before this was measured.
        flags: why it may not be an object on the support; flagged ones are not trained on unless asked for.
    """

    id: int
    name: str = ""
    n_vertices: int
    area_m2: float
    centroid: tuple[float, float, float]
    extents: tuple[float, float, float]
    concave_share: float = 0.0
    seen: float | None = None
    flags: list[Flag] = []

    @property
    def reasons(self) -> str:
        """The flags in words, separated by semicolons."""
        return "; ".join(FLAG_TEXTS[flag] for flag in self.flags)


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


HOLLOW_SHARE = 0.25
"""Share of the surface inside the hull from which an object is hollow, or several: as `core.creases.CONCAVE_SHARE`."""

FLAG_CODES: dict[Flag, str] = {
    "cut": "object-cut",
    "floating": "object-floating",
    "with-camera": "object-with-camera",
    "flat": "object-flat",
}
"""The code of the finding for each flag."""

FLAG_FIXES: dict[Flag, str] = {
    "cut": "a larger --workspace of `reconstruct` if it is an object, a smaller one if it is a part of the robot.",
    "floating": "--workspace of `reconstruct` without it; or --plane of `objects`, if it stands on another plane.",
    "with-camera": "--near of `reconstruct` beyond what is mounted on the camera.",
    "flat": "train on it with --flagged of `correspondences`, if it is a thin object.",
}
"""What to do about each flag."""


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

    def findings(self) -> list[Finding]:
        """What is doubtful about the objects."""
        place = self.path.name
        warnings = self.metadata.warnings
        found = [
            Finding(FLAG_CODES[flag], f"{place} object {row.id}", FLAG_TEXTS[flag], FLAG_FIXES[flag])
            for row in self.instances
            for flag in row.flags
        ]
        # The hull of a hollow object, or of several, has sides that nothing is behind.
        solid = [row for row in self.instances if not row.flags and row.concave_share < HOLLOW_SHARE]
        one_sided = [row for row in solid if row.seen is not None and row.seen < ONE_SIDE]
        if one_sided:
            which = ", ".join(f"{row.id} ({row.seen:.0%})" for row in one_sided)
            found.append(
                Finding(
                    "object-one-side",
                    place,
                    f"share of the surface seen of object {which}; all around it is more than {ONE_SIDE:.0%}",
                    "record views from more sides, if descriptors of the other sides matter.",
                )
            )
        if not self.instances:
            found.append(Finding("no-object", place, " ".join(warnings), "look at the mesh: bask-data view"))
        # The warning of flagged objects quotes their reasons, one of which has the word, too.
        if uncertain := [text for text in warnings if "support" in text and not text.startswith("flagged")]:
            found.append(Finding("support-uncertain", place, "; ".join(uncertain), "--plane, --up or --margin"))
        if hollow := [row for row in self.instances if row.concave_share >= HOLLOW_SHARE]:
            which = ", ".join(f"{row.id} ({row.concave_share:.0%})" for row in hollow)
            found.append(
                Finding(
                    "objects-touch",
                    place,
                    f"share of the surface inside the hull: object {which}; below {HOLLOW_SHARE:.0%} for one that is "
                    "not hollow",
                    "move the objects apart and record again, or a smaller --eps.",
                )
            )
        return found

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
