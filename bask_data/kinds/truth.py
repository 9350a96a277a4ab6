"""Ground truth of a recording, for evaluation and reports. Of the stages, only `encode --source truth` reads it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
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


ROBOT = 255
"""Label of the robot; no object has it."""
OBJECTS = "objects"
"""Group with the objects' poses, beside the cameras' groups."""


class TruthMetadata(Metadata):
    """Names of the labels, and poses of static objects, if known.

    Args:
        label_names: names by label; 0 is background and has no name.
        world_from_object: by label, rows of a rigid (4, 4) transform, metres. The object's frame is the same in all
            recordings of a dataset, so that a point picked in one recording is known in the others.
        pose_error: by label, error of these transforms stated by their source, metres.
        object_labels: labels of the rows of `objects/world_from_object`.
        touching: pairs of labels whose bodies touch, so that geometry alone cannot separate them.
    """

    label_names: dict[int, str]
    world_from_object: dict[int, list[list[float]]] = {}
    pose_error: dict[int, float] = {}
    object_labels: list[int] = []
    touching: list[tuple[int, int]] = []


class Truth(Artifact):
    """Ground-truth labels of each frame, from annotation or simulation; a simulator also knows depth and poses."""

    kind = "truth"
    scope = "recording"
    schema_version = 2
    metadata_model = TruthMetadata
    arrays = {
        "{camera}/instance": ArraySpec(
            ("t", "h", "w"), "uint8", "Label of the visible object; 0 is background, 255 the robot."
        ),
        "{camera}/depth": ArraySpec(
            ("t", "h", "w"),
            "uint16",
            "Exact z-depth in units of `scale_m` metres; 0 means nothing.",
            attributes=("scale_m",),
            optional=True,
        ),
        "{camera}/world_from_camera": ArraySpec(
            ("t", "4", "4"), "float64", "Exact transforms, where the recording's carry noise.", "metre", optional=True
        ),
        "objects/world_from_object": ArraySpec(
            ("t", "k", "4", "4"),
            "float64",
            "Where each object is at each frame; rows as `object_labels` says.",
            "metre",
            optional=True,
        ),
    }

    @property
    def label_names(self) -> dict[int, str]:
        """Names by label."""
        return self.metadata.label_names

    def instance(self, camera: str, i_frame: int) -> np.ndarray:
        """Labels of one frame (h, w) uint8."""
        return read_frame(self.group[f"{camera}/instance"], i_frame, self.path / camera / "instance")  # type: ignore[arg-type]

    @property
    def touching(self) -> list[tuple[int, int]]:
        """Pairs of labels whose bodies touch."""
        return self.metadata.touching

    @cached_property
    def has_depth(self) -> bool:
        """Whether exact depth and camera transforms are known."""
        return all(f"{camera}/depth" in self.group for camera in self.camera_names)

    def depth(self, camera: str, i_frame: int) -> np.ndarray:
        """Exact z-depth of one frame (h, w) float32 metres; 0 means no surface."""
        import numpy as np

        array = self.group[f"{camera}/depth"]
        raw = read_frame(array, i_frame, self.path / camera / "depth")  # type: ignore[arg-type]
        scale = float(array.attrs["scale_m"])  # type: ignore[arg-type]
        return raw.astype(np.float32) * np.float32(scale)

    def world_from_cameras(self, camera: str) -> np.ndarray:
        """Exact poses of a camera (t, 4, 4) float64, metres."""
        if camera not in self._world_from_cameras:
            self._world_from_cameras[camera] = read_all(self.group, f"{camera}/world_from_camera", self.path)
        return self._world_from_cameras[camera]

    @cached_property
    def _world_from_cameras(self) -> dict[str, np.ndarray]:
        """Cache, as loops over frames request the poses in each frame."""
        return {}

    @property
    def world_from_objects(self) -> np.ndarray | None:
        """Poses of the objects at each frame (t, k, 4, 4) float64, metres; None if unknown."""
        if f"{OBJECTS}/world_from_object" not in self.group:
            return None
        return read_all(self.group, f"{OBJECTS}/world_from_object", self.path)

    @staticmethod
    def write(
        out: Path,
        label_names: dict[int, str],
        cameras: dict[str, tuple[int, tuple[int, int], Callable[[int], np.ndarray]]],
        world_from_object: dict[int, list[list[float]]] | None = None,
        pose_error: dict[int, float] | None = None,
    ) -> None:
        """Write labels; per camera (number of frames, (height, width), function that returns a frame's labels)."""
        metadata = TruthMetadata(
            label_names=label_names, world_from_object=world_from_object or {}, pose_error=pose_error or {}
        )
        group = start(out, Truth, metadata.model_dump(mode="json"))
        for name, (n_frames, size, labels) in cameras.items():
            write_group(out / name, {"bask": {"role": "camera"}})
            writer = FrameWriter(group, Truth, f"{name}/instance", n_frames, size)
            for i_frame in range(n_frames):
                writer.append(labels(i_frame))
            writer.close()

    @staticmethod
    @contextmanager
    def writer(out: Path, metadata: TruthMetadata, world_from_objects: np.ndarray) -> Iterator[TruthWriter]:
        """Open a writer of exact labels, depth and poses, camera by camera, frame by frame.

        Args:
            world_from_objects: (t, k, 4, 4) float64, metres, rows in the order of the metadata's `object_labels`.
        """
        group = start(out, Truth, metadata.model_dump(mode="json"))
        write_group(out / OBJECTS, {"bask": {"role": OBJECTS}})
        write_array(group, Truth, f"{OBJECTS}/world_from_object", world_from_objects)
        writer = TruthWriter(out, group)
        yield writer
        writer.close()


class TruthWriter:
    """Writer of ground truth, camera by camera."""

    def __init__(self, out: Path, group: zarr.Group) -> None:
        self._out, self._group = out, group
        self._cameras: list[CameraTruthWriter] = []

    def camera(self, name: str, n_frames: int, size: tuple[int, int], depth_scale: float) -> CameraTruthWriter:
        """Begin one camera; `size` is (height, width), depth is in units of `depth_scale` metres."""
        write_group(self._out / name, {"bask": {"role": "camera"}})
        self._cameras.append(CameraTruthWriter(self._group, name, n_frames, size, depth_scale))
        return self._cameras[-1]

    def close(self) -> None:
        """Finish all cameras."""
        for camera in self._cameras:
            camera.close()


class CameraTruthWriter:
    """Writer of one camera's ground truth, frame by frame."""

    def __init__(self, group: zarr.Group, name: str, n_frames: int, size: tuple[int, int], depth_scale: float) -> None:
        self._group, self._name = group, name
        self._instance = FrameWriter(group, Truth, f"{name}/instance", n_frames, size)
        self._depth = FrameWriter(group, Truth, f"{name}/depth", n_frames, size, scale_m=depth_scale)
        self._world_from_cameras: list[np.ndarray] = []

    def append(self, instance: np.ndarray, depth_raw: np.ndarray, world_from_camera: np.ndarray) -> None:
        """Append a frame: labels (h, w) uint8, exact depth (h, w) uint16, pose (4, 4), metres."""
        self._instance.append(instance)
        self._depth.append(depth_raw)
        self._world_from_cameras.append(world_from_camera)

    def close(self) -> None:
        """Write the buffers."""
        import numpy as np

        self._instance.close()
        self._depth.close()
        write_array(self._group, Truth, f"{self._name}/world_from_camera", np.stack(self._world_from_cameras))
