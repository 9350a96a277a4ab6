"""Keypoint tracks: 3D keypoints of a demonstration over time."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from bask_data.artifact import ArraySpec, Artifact, Metadata, write_group
from bask_data.kinds.arrays import read_all, start, write_array

if TYPE_CHECKING:
    import numpy as np


class KeypointsMetadata(Metadata):
    """Names of the keypoints and the filter that tracked them."""

    names: list[str]
    filter: str


_PER_FRAME = ("mean", "covariance", "mode", "n_eff", "log_evidence")


class KeypointTrack(Artifact):
    """What a filter believes of each keypoint after each frame."""

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
        """(t, k, 3) float32, metres, world frame."""
        return read_all(self.group, "mean", self.path)

    @cached_property
    def covariance(self) -> np.ndarray:
        """(t, k, 3, 3) float32, square metres."""
        return read_all(self.group, "covariance", self.path)

    @cached_property
    def mode(self) -> np.ndarray:
        """(t, k, 3) float32, metres, world frame."""
        return read_all(self.group, "mode", self.path)

    @cached_property
    def n_eff(self) -> np.ndarray:
        """(t, k) float32."""
        return read_all(self.group, "n_eff", self.path)

    @cached_property
    def log_evidence(self) -> np.ndarray:
        """(t, k) float32."""
        return read_all(self.group, "log_evidence", self.path)

    def pixel(self, camera: str) -> np.ndarray:
        """(t, k, 2) float32 pixels of the mean in a camera's images."""
        return read_all(self.group, f"{camera}/pixel", self.path)

    def observed(self, camera: str) -> np.ndarray:
        """(t, k) bool."""
        return read_all(self.group, f"{camera}/observed", self.path)

    @staticmethod
    @contextmanager
    def writer(out: Path, *, names: list[str], filter: str, cameras: list[str]) -> Iterator[KeypointsWriter]:
        """Append frame by frame."""
        writer = KeypointsWriter(out, names, filter, cameras)
        yield writer
        writer.close()


class KeypointsWriter:
    """Collects a track. A frame of 16 keypoints takes about 1.2 kB: an hour at 30 Hz is 130 MB."""

    def __init__(self, out: Path, names: list[str], filter: str, cameras: list[str]) -> None:
        self._out = out
        self._group = start(out, KeypointTrack, {"names": names, "filter": filter})
        self._per_frame: dict[str, list[np.ndarray]] = {name: [] for name in _PER_FRAME}
        self._per_camera: dict[str, dict[str, list[np.ndarray]]] = {
            camera: {"pixel": [], "observed": []} for camera in cameras
        }

    def append(
        self,
        *,
        mean: np.ndarray,
        covariance: np.ndarray,
        mode: np.ndarray,
        n_eff: np.ndarray,
        log_evidence: np.ndarray,
        cameras: dict[str, tuple[np.ndarray, np.ndarray]],
    ) -> None:
        """Add a frame; shapes as the schema has them without t; per camera (pixel (k, 2), observed (k,))."""
        values = (mean, covariance, mode, n_eff, log_evidence)
        for name, value in zip(_PER_FRAME, values, strict=True):
            self._per_frame[name].append(value)
        for camera, (pixel, observed) in cameras.items():
            self._per_camera[camera]["pixel"].append(pixel)
            self._per_camera[camera]["observed"].append(observed)

    def close(self) -> None:
        """Write everything."""
        import numpy as np

        for name, values in self._per_frame.items():
            write_array(self._group, KeypointTrack, name, np.asarray(values, dtype=np.float32))
        for camera, arrays in self._per_camera.items():
            write_group(self._out / camera, {"bask": {"role": "camera"}})
            write_array(self._group, KeypointTrack, f"{camera}/pixel", np.asarray(arrays["pixel"], dtype=np.float32))
            write_array(self._group, KeypointTrack, f"{camera}/observed", np.asarray(arrays["observed"], dtype=bool))
