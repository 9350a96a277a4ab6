"""Reference keypoints: their descriptors, and where each was picked."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from bask_data.artifact import REMAKE, ArraySpec, Artifact, Metadata
from bask_data.errors import BadData
from bask_data.kinds.arrays import read_all, start, write_array

if TYPE_CHECKING:
    import numpy as np


class Pick(Metadata):
    """Where a keypoint was picked.

    Args:
        recording: scene or demonstration.
        u, v: pixel of the recording's image; integers are pixel centres.
        instance: instance in the scene's masks; 0 if unknown.
        point_world: metres, world frame of that recording; None without depth.
    """

    name: str
    recording: str
    camera: str
    frame: int
    u: float
    v: float
    instance: int = 0
    point_world: tuple[float, float, float] | None = None


class ReferenceMetadata(Metadata):
    """The picks, in the order of the keypoints."""

    picks: list[Pick]


class ReferenceKeypoints(Artifact):
    """Reference descriptors of k keypoints."""

    kind = "reference"
    scope = "dataset"
    has_variants = True
    metadata_model = ReferenceMetadata
    arrays = {"descriptors": ArraySpec(("k", "d"), "float32", "Descriptor of each keypoint where it was picked.")}

    @cached_property
    def descriptors(self) -> np.ndarray:
        """Descriptors (k, d) float32; `BadData` if they are not finite."""
        import numpy as np

        descriptors = read_all(self.group, "descriptors", self.path)
        if not np.isfinite(descriptors).all():
            raise BadData(self.path, "descriptors", expected="finite numbers", got="NaN or infinity", fix=REMAKE)
        return descriptors

    @property
    def picks(self) -> list[Pick]:
        """Where each keypoint was picked."""
        return self.metadata.picks

    @property
    def names(self) -> list[str]:
        """Names of the keypoints."""
        return [pick.name for pick in self.picks]

    @staticmethod
    def write(out: Path, *, descriptors: np.ndarray, picks: list[Pick]) -> None:
        """Write descriptors (k, d) and their k picks."""
        group = start(out, ReferenceKeypoints, {"picks": [pick.model_dump() for pick in picks]})
        write_array(group, ReferenceKeypoints, "descriptors", descriptors)
