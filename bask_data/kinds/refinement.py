"""Refinements: what depth says about errors of a scan's poses, and the poses without them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal

from bask_data.artifact import Artifact, Metadata, write_group
from bask_data.kinds.arrays import read_all, start, write_array
from bask_data.specs import ArraySpec

if TYPE_CHECKING:
    import numpy as np

Row = tuple[float, float, float, float]


class ResidualRow(Metadata):
    """How far held-out pairs of frames are from meeting.

    Args:
        distance_m: mean point-to-plane distance, metres.
        shift_m, angle_deg: medians of what each pair would still have to move for its depth to meet.
    """

    distance_m: float
    shift_m: float
    angle_deg: float


class RefinedCamera(Metadata):
    """What was found of one camera.

    Args:
        model: the explanation that held-out pairs support: none, one rigid error of all poses, or drift.
        why: one sentence.
        n_pairs: pairs of frames that see the same surfaces.
        given_from_true: true world_from_camera = given @ this, camera frame, rows; None unless a hand-eye error was
            found.
        deviation_m, deviation_deg: standard deviations of the hand-eye correction along its least certain axis.
        of_scale_m: translation that depth wrong in scale by half a percent would look like.
        before, after: of the given poses, and of the best explanation; None if too few pairs overlap.
    """

    camera: str
    model: Literal["none", "hand-eye", "drift"]
    verdict: Literal["refined", "no better", "cannot tell"]
    why: str
    n_pairs: int
    given_from_true: tuple[Row, Row, Row, Row] | None = None
    deviation_m: float | None = None
    deviation_deg: float | None = None
    of_scale_m: float | None = None
    before: ResidualRow | None = None
    after: ResidualRow | None = None


class RefinementMetadata(Metadata):
    """What was found of each camera."""

    cameras: list[RefinedCamera]


class PoseRefinement(Artifact):
    """Errors of a scan's poses, and the poses without them."""

    kind = "refinement"
    scope = "scene"
    schema_version = 1
    metadata_model = RefinementMetadata
    arrays = {
        "{camera}/world_from_camera": ArraySpec(
            ("t", "4", "4"), "float64", "Refined transforms; as given where the verdict is not `refined`.", "metre"
        )
    }

    @property
    def cameras(self) -> list[RefinedCamera]:
        """What was found of each camera."""
        return self.metadata.cameras

    def world_from_cameras(self, camera: str) -> np.ndarray:
        """Poses of a camera (t, 4, 4) float64, metres."""
        return read_all(self.group, f"{camera}/world_from_camera", self.path)

    @property
    def is_refined(self) -> bool:
        """Whether the poses of any camera are better than given."""
        return any(row.verdict == "refined" for row in self.cameras)

    @staticmethod
    def write(out: Path, rows: list[RefinedCamera], poses: dict[str, np.ndarray]) -> None:
        """Write what was found, and the poses (t, 4, 4) of each camera."""
        metadata = {"cameras": [row.model_dump() for row in rows]}
        group = start(out, PoseRefinement, metadata)
        for name, world_from_cameras in poses.items():
            write_group(out / name, {"bask": {"role": "camera"}})
            write_array(group, PoseRefinement, f"{name}/world_from_camera", world_from_cameras)
