"""Visible masks: which object each pixel shows."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from bask_data.artifact import ArraySpec, Artifact, Metadata, write_group
from bask_data.kinds.arrays import FrameWriter, read_all, read_frame, start, write_array

if TYPE_CHECKING:
    import numpy as np
    import zarr


class MasksMetadata(Metadata):
    """Number of instances of the scene, and counts of decided pixels by reason, as the stage documents them."""

    n_instances: int
    pixels: dict[str, int] = {}


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
        return self._instance.shape[0]

    def instance(self, i_frame: int) -> np.ndarray:
        """The visible instance at each pixel (h, w) uint8; 0 is none."""
        return read_frame(self._instance, i_frame, self.path / "instance")

    @cached_property
    def visible_fraction(self) -> np.ndarray:
        """(t, k) float32: the share of each instance's projection that is visible, in [0, 1]; NaN where it has none."""
        return read_all(self._group, "visible_fraction", self.path)


class VisibleMasks(Artifact):
    """Visible (modal) masks of all objects in all frames of a scan; being disjoint, they are one label image."""

    kind = "masks"
    scope = "scene"
    metadata_model = MasksMetadata
    arrays = {
        "{camera}/instance": ArraySpec(("t", "h", "w"), "uint8", "Instance visible at each pixel; 0 is none."),
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
        """Write masks camera by camera, frame by frame; `pixels` may be counted up on the way."""
        writer = MasksWriter(out, n_instances)
        yield writer
        writer.close()


class MasksWriter:
    """Streams masks into an artifact."""

    def __init__(self, out: Path, n_instances: int) -> None:
        self._out = out
        self._n_instances = n_instances
        self._group = start(out, VisibleMasks, {"n_instances": n_instances})
        self._cameras: list[CameraMasksWriter] = []
        self.pixels: dict[str, int] = {}

    def camera(self, name: str, n_frames: int, height: int, width: int) -> CameraMasksWriter:
        """Begin one camera."""
        write_group(self._out / name, {"bask": {"role": "camera"}})
        self._cameras.append(CameraMasksWriter(self._group, name, n_frames, height, width, self._n_instances))
        return self._cameras[-1]

    def close(self) -> None:
        """Finish all cameras and write the counts."""
        for camera in self._cameras:
            camera.close()
        checked = MasksMetadata(n_instances=self._n_instances, pixels=self.pixels).model_dump(mode="json")
        write_group(self._out, {"bask": {"kind": VisibleMasks.kind, "schema": VisibleMasks.schema_version, **checked}})


class CameraMasksWriter:
    """Streams one camera's masks."""

    def __init__(self, group: zarr.Group, name: str, n_frames: int, height: int, width: int, n_instances: int) -> None:
        self._group, self._name, self._n_instances = group, name, n_instances
        self._instance = FrameWriter(group, VisibleMasks, f"{name}/instance", n_frames, (height, width))
        self._visible_fraction: list[np.ndarray] = []

    def append(self, instance: np.ndarray, visible_fraction: np.ndarray) -> None:
        """Add a frame: labels (h, w) uint8 and the visible share of each instance (k,)."""
        self._instance.append(instance)
        self._visible_fraction.append(visible_fraction)

    def close(self) -> None:
        """Write what is buffered."""
        import numpy as np

        self._instance.close()
        table = np.asarray(self._visible_fraction, dtype=np.float32).reshape(
            len(self._visible_fraction), self._n_instances
        )
        write_array(self._group, VisibleMasks, f"{self._name}/visible_fraction", table)
