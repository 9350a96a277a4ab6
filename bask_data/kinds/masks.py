"""Visible masks: the instance at each pixel."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from bask_data.artifact import Artifact, Metadata, write_group
from bask_data.kinds.arrays import FrameWriter, read_all, read_frame, start, write_array
from bask_data.specs import ArraySpec

if TYPE_CHECKING:
    import numpy as np
    import zarr


class MasksMetadata(Metadata):
    """Number of instances of the scene, and how their pixels were decided.

    Args:
        pixels: counts by reason, as documented by the stage.
        noise: by camera, (a, b): the standard deviation between measured depth and mesh is a + b z metres; cameras
            for which it could not be estimated are missing.
        tolerance: by camera, (a, b): depth and mesh were taken to agree within a + b z metres.
    """

    n_instances: int
    pixels: dict[str, int] = {}
    noise: dict[str, tuple[float, float]] = {}
    tolerance: dict[str, tuple[float, float]] = {}


class CameraMasks:
    """One camera's masks."""

    def __init__(self, group: zarr.Group, path: Path) -> None:
        self._group = group
        self.path = path
        self.name = path.name

    @cached_property
    def _instance(self) -> zarr.Array:
        return self._group["instance"]  # type: ignore[return-value]

    @property
    def n_frames(self) -> int:
        """Number of frames."""
        return self._instance.shape[0]

    def instance(self, i_frame: int) -> np.ndarray:
        """The visible instance at each pixel (h, w) uint8; 0 is none."""
        return read_frame(self._instance, i_frame, self.path / "instance")

    def measured(self, i_frame: int) -> np.ndarray:
        """Whether measured depth confirms each pixel's label (h, w) bool.

        False where an object was a candidate but no depth was measured: exclude these pixels to use certain labels
        only.
        """
        return read_frame(self._measured, i_frame, self.path / "measured") > 0

    @cached_property
    def _measured(self) -> zarr.Array:
        return self._group["measured"]  # type: ignore[return-value]

    @cached_property
    def measured_fraction(self) -> np.ndarray:
        """Share of each mask's pixels that were measured (t, k) float32, in [0, 1]; NaN: empty mask."""
        return read_all(self._group, "measured_fraction", self.path)

    @cached_property
    def visible_fraction(self) -> np.ndarray:
        """Share of each instance's amodal mask that is visible (t, k) float32, in [0, 1]; NaN: out of view."""
        return read_all(self._group, "visible_fraction", self.path)


class VisibleMasks(Artifact):
    """Visible (modal) masks of all objects in all frames of a scan; being disjoint, they are one label image."""

    kind = "masks"
    scope = "scene"
    metadata_model = MasksMetadata
    schema_version = 2
    arrays = {
        "{camera}/instance": ArraySpec(("t", "h", "w"), "uint8", "Instance visible at each pixel; 0 is none."),
        "{camera}/measured": ArraySpec(
            ("t", "h", "w"),
            "uint8",
            "0 where an object was a candidate and no depth was measured, so that `instance` is an inference; else 1.",
        ),
        "{camera}/measured_fraction": ArraySpec(
            ("t", "k"), "float32", "Share of each visible mask's pixels whose `measured` is 1; NaN: empty mask."
        ),
        "{camera}/visible_fraction": ArraySpec(
            ("t", "k"),
            "float32",
            "Visible share of each instance's projection into the image (BOP: visib_fract); NaN: none.",
        ),
    }

    @property
    def n_instances(self) -> int:
        """Number of objects in the scene."""
        return self.metadata.n_instances

    def camera(self, name: str) -> CameraMasks:
        """One camera's masks."""
        return CameraMasks(self.group[name], self.path / name)  # type: ignore[arg-type]

    @staticmethod
    @contextmanager
    def writer(out: Path, n_instances: int) -> Iterator[MasksWriter]:
        """Open a writer of masks; `pixels`, `noise` and `tolerance` may be set until it closes."""
        writer = MasksWriter(out, n_instances)
        yield writer
        writer.close()


class MasksWriter:
    """Writer of masks, camera by camera."""

    def __init__(self, out: Path, n_instances: int) -> None:
        self._out = out
        self._n_instances = n_instances
        self._group = start(out, VisibleMasks, {"n_instances": n_instances})
        self._cameras: list[CameraMasksWriter] = []
        self.pixels: dict[str, int] = {}
        self.noise: dict[str, tuple[float, float]] = {}
        self.tolerance: dict[str, tuple[float, float]] = {}

    def camera(self, name: str, n_frames: int, height: int, width: int) -> CameraMasksWriter:
        """Begin one camera."""
        write_group(self._out / name, {"bask": {"role": "camera"}})
        self._cameras.append(CameraMasksWriter(self._group, name, n_frames, height, width, self._n_instances))
        return self._cameras[-1]

    def close(self) -> None:
        """Finish all cameras and write the metadata."""
        for camera in self._cameras:
            camera.close()
        checked = MasksMetadata(
            n_instances=self._n_instances, pixels=self.pixels, noise=self.noise, tolerance=self.tolerance
        ).model_dump(mode="json")
        write_group(self._out, {"bask": {"kind": VisibleMasks.kind, "schema": VisibleMasks.schema_version, **checked}})


class CameraMasksWriter:
    """Writer of one camera's masks, frame by frame."""

    def __init__(self, group: zarr.Group, name: str, n_frames: int, height: int, width: int, n_instances: int) -> None:
        self._group, self._name, self._n_instances = group, name, n_instances
        self._instance = FrameWriter(group, VisibleMasks, f"{name}/instance", n_frames, (height, width))
        self._measured = FrameWriter(group, VisibleMasks, f"{name}/measured", n_frames, (height, width))
        self._visible_fraction: list[np.ndarray] = []
        self._measured_fraction: list[np.ndarray] = []

    def append(self, instance: np.ndarray, visible_fraction: np.ndarray, measured: np.ndarray | None = None) -> None:
        """Append a frame.

        Args:
            instance: labels (h, w) uint8.
            visible_fraction: visible share of each instance (k,).
            measured: (h, w) bool, as in `CameraMasks.measured`; True everywhere by default.
        """
        import numpy as np

        measured = np.ones(instance.shape, bool) if measured is None else measured
        self._instance.append(instance)
        self._measured.append(measured.astype(np.uint8))
        self._visible_fraction.append(visible_fraction)
        n_visible = np.bincount(instance.reshape(-1), minlength=self._n_instances + 1)[1:]
        n_measured = np.bincount(instance[measured], minlength=self._n_instances + 1)[1:]
        self._measured_fraction.append(np.where(n_visible > 0, n_measured / np.maximum(n_visible, 1), np.nan))

    def close(self) -> None:
        """Write the buffers."""
        import numpy as np

        self._instance.close()
        self._measured.close()
        for name in ("visible_fraction", "measured_fraction"):
            rows: list[np.ndarray] = getattr(self, f"_{name}")
            table = np.asarray(rows, dtype=np.float32).reshape(len(rows), self._n_instances)
            write_array(self._group, VisibleMasks, f"{self._name}/{name}", table)
