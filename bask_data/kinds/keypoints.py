"""Keypoint tracks: 3D keypoints of a demonstration over time."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from bask_data.artifact import Artifact, Metadata, write_group
from bask_data.kinds.arrays import RowWriter, read_all, spec_of, start
from bask_data.specs import ArraySpec

if TYPE_CHECKING:
    import numpy as np


class KeypointsMetadata(Metadata):
    """Names of the keypoints and the filter that tracked them."""

    names: list[str]
    filter: str


class KeypointTrack(Artifact):
    """A filter's belief of each keypoint after each frame."""

    kind = "keypoints"
    scope = "demonstration"
    has_variants = True
    metadata_model = KeypointsMetadata
    arrays = {
        "mean": ArraySpec(("t", "k", "3"), "float32", "Mean position in the world frame; NaN: not localised.", "metre"),
        "covariance": ArraySpec(
            ("t", "k", "3", "3"), "float32", "Covariance of the position, the certainty.", "metre^2"
        ),
        "mode": ArraySpec(("t", "k", "3"), "float32", "Most likely position in the world frame.", "metre"),
        "n_eff": ArraySpec(("t", "k"), "float32", "Effective number of particles (particle filter) or cells."),
        "log_evidence": ArraySpec(
            ("t", "k"), "float32", "Log of the evidence of the frame under the belief before it."
        ),
        "{camera}/pixel": ArraySpec(
            ("t", "k", "2"),
            "float32",
            "Mean position projected into the image, (u, v); NaN: behind the camera.",
            "pixel",
        ),
        "{camera}/observed": ArraySpec(
            ("t", "k"), "bool", "Whether the camera more likely than not sees the keypoint: in view, not hidden."
        ),
    }

    @property
    def names(self) -> list[str]:
        """Names of the keypoints."""
        return self.metadata.names

    @cached_property
    def mean(self) -> np.ndarray:
        """Mean positions (t, k, 3) float32, metres, world frame; NaN: not localised."""
        return read_all(self.group, "mean", self.path)

    @cached_property
    def covariance(self) -> np.ndarray:
        """Covariances (t, k, 3, 3) float32, square metres."""
        return read_all(self.group, "covariance", self.path)

    @cached_property
    def mode(self) -> np.ndarray:
        """Most likely positions (t, k, 3) float32, metres, world frame."""
        return read_all(self.group, "mode", self.path)

    @cached_property
    def n_eff(self) -> np.ndarray:
        """Effective sample sizes (t, k) float32."""
        return read_all(self.group, "n_eff", self.path)

    @cached_property
    def log_evidence(self) -> np.ndarray:
        """Log evidence of each frame under the belief before it (t, k) float32."""
        return read_all(self.group, "log_evidence", self.path)

    def pixel(self, camera: str) -> np.ndarray:
        """Projected means (t, k, 2) float32, pixels of a camera's images; NaN: behind the camera."""
        return read_all(self.group, f"{camera}/pixel", self.path)

    def observed(self, camera: str) -> np.ndarray:
        """Whether the camera more likely than not sees each keypoint (t, k) bool."""
        return read_all(self.group, f"{camera}/observed", self.path)

    @staticmethod
    @contextmanager
    def writer(
        out: Path, *, names: list[str], filter: str, cameras: list[str], n_kept: int = 0
    ) -> Iterator[KeypointsWriter]:
        """Open a writer of frames.

        Args:
            n_kept: frames to keep of an unfinished track, whole chunks.
        """
        writer = KeypointsWriter(out, names, filter, cameras, n_kept)
        yield writer
        writer.close()


class KeypointsWriter:
    """Writer of a track. A frame of 16 keypoints takes about 1.2 kB, an hour at 30 Hz 130 MB."""

    def __init__(self, out: Path, names: list[str], filter: str, cameras: list[str], n_kept: int) -> None:
        group = start(out, KeypointTrack, {"names": names, "filter": filter})
        for camera in cameras:
            write_group(out / camera, {"bask": {"role": "camera"}})
        self._cameras = cameras
        common = [name for name in KeypointTrack.arrays if not name.startswith("{camera}/")]
        of_camera = [
            name.format(camera=camera) for camera in cameras for name in ("{camera}/pixel", "{camera}/observed")
        ]
        self._rows = {
            name: RowWriter(group, KeypointTrack, name, _row_shape(name, len(names)), n_kept)
            for name in (*common, *of_camera)
        }

    def append(
        self,
        *,
        mean: np.ndarray,
        covariance: np.ndarray,
        mode: np.ndarray,
        n_eff: np.ndarray,
        log_evidence: np.ndarray,
        cameras: Mapping[str, tuple[np.ndarray, np.ndarray]],
    ) -> bool:
        """Append a frame, with shapes as in the schema without t; per camera (pixel (k, 2), observed (k,)).

        Returns:
            whether all frames so far are on disk.
        """
        row = {"mean": mean, "covariance": covariance, "mode": mode, "n_eff": n_eff, "log_evidence": log_evidence}
        for camera in self._cameras:
            row[f"{camera}/pixel"], row[f"{camera}/observed"] = cameras[camera]
        on_disk = [self._rows[name].append(value) for name, value in row.items()]
        return all(on_disk)

    def close(self) -> None:
        """Write the buffers."""
        for rows in self._rows.values():
            rows.close()


def _row_shape(name: str, k: int) -> tuple[int, ...]:
    """Shape of one frame of an array, by its schema."""
    _, _, *rest = spec_of(KeypointTrack, name).dims
    return (k, *map(int, rest))
