"""Ground truth of a recording. Only evaluation and reports may read it, never a stage that makes data."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from bask_data.artifact import ArraySpec, Artifact, Metadata, write_group
from bask_data.kinds.arrays import FrameWriter, read_frame, start

if TYPE_CHECKING:
    import numpy as np


class TruthMetadata(Metadata):
    """Names of the labels; 0 is background and has no name. Where static objects stand, if that is known.

    Args:
        world_from_object: by label, rows of a rigid (4, 4) transform, metres. The object's frame is the same in every
            recording of a dataset that shows the object, so that a point picked in one has a place in the others.
        pose_error: by label, metres that these transforms may be wrong by, as whoever made them says.
    """

    label_names: dict[int, str]
    world_from_object: dict[int, list[list[float]]] = {}
    pose_error: dict[int, float] = {}


class Truth(Artifact):
    """Instance labels per frame, as people or a simulator gave them."""

    kind = "truth"
    scope = "recording"
    metadata_model = TruthMetadata
    arrays = {"{camera}/instance": ArraySpec(("t", "h", "w"), "uint8", "Label of the visible object; 0 is background.")}

    @property
    def label_names(self) -> dict[int, str]:
        """Name of each label."""
        return self.metadata.label_names

    def instance(self, camera: str, i_frame: int) -> np.ndarray:
        """Labels of one frame (h, w) uint8."""
        return read_frame(self.group[f"{camera}/instance"], i_frame, self.path / camera / "instance")  # type: ignore[arg-type]

    @staticmethod
    def write(
        out: Path,
        label_names: dict[int, str],
        cameras: dict[str, tuple[int, tuple[int, int], Callable[[int], np.ndarray]]],
        world_from_object: dict[int, list[list[float]]] | None = None,
        pose_error: dict[int, float] | None = None,
    ) -> None:
        """Write labels; per camera (number of frames, (height, width), function that gives a frame's labels)."""
        group = start(
            out,
            Truth,
            {
                "label_names": label_names,
                "world_from_object": world_from_object or {},
                "pose_error": pose_error or {},
            },
        )
        for name, (n_frames, size, labels) in cameras.items():
            write_group(out / name, {"bask": {"role": "camera"}})
            writer = FrameWriter(group, Truth, f"{name}/instance", n_frames, size)
            for i_frame in range(n_frames):
                writer.append(labels(i_frame))
            writer.close()
