"""Frames of a scene for evaluation: exact where ground truth has depth and cameras, else as recorded."""

from __future__ import annotations

from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, NamedTuple

from bask_data.artifact import MANIFEST
from bask_data.dataset import Dataset
from bask_data.evaluation.identity_names import identity_names
from bask_data.kinds import Camera, Scan, Truth, VisibleMasks
from bask_data.kinds.truth import ROBOT

if TYPE_CHECKING:
    import numpy as np

N_FRAMES_KEPT = 64
"""Frames whose depth and labels stay in memory."""


class Frame(NamedTuple):
    """A frame of a scene, by its camera's name and its number."""

    camera: str
    i: int


class Frames:
    """One scene's images, depth, labels and cameras."""

    def __init__(self, dataset: Dataset, scene: str) -> None:
        self.scene = scene
        self._dataset = dataset
        self._scan = Scan(dataset.path(Scan, scene))
        self.masks = VisibleMasks(dataset.path(VisibleMasks, scene))
        path = dataset.path(Truth, scene)
        truth = Truth(path) if (path / MANIFEST).exists() else None
        self.truth = truth if truth is not None and truth.has_depth else None
        self.depth = lru_cache(N_FRAMES_KEPT)(self._depth)
        self.labels = lru_cache(N_FRAMES_KEPT)(self._labels)

    @cached_property
    def _cameras(self) -> dict[str, Camera]:
        return {camera.name: camera for camera in self._scan.cameras}

    @cached_property
    def cameras(self) -> list[str]:
        """Cameras to measure on: with ground truth, those that it covers."""
        return [name for name in self._cameras if self.truth is None or name in self.truth.camera_names]

    def between(self, begin: float, end: float, most: int) -> list[Frame]:
        """At most this many frames of all cameras, evenly spaced between two shares of each camera's frames."""
        import numpy as np

        everything = []
        for camera in self.cameras:
            # Rounded like the share that `train` holds out.
            first, last = (
                n - round((1.0 - share) * n) for n in [self._cameras[camera].n_frames] for share in (begin, end)
            )
            everything += [Frame(camera, i) for i in range(first, last)]
        chosen = np.unique(np.linspace(0, len(everything) - 1, min(most, len(everything))).round().astype(int))
        return [everything[i] for i in chosen]

    def size(self, camera: str) -> tuple[int, int]:
        """(height, width) of a camera's images."""
        return self._cameras[camera].height, self._cameras[camera].width

    def K(self, frame: Frame) -> np.ndarray:
        """Intrinsics (3, 3) of a frame, pixels."""
        K: np.ndarray = self._cameras[frame.camera].Ks[frame.i]
        return K

    def rgb(self, frame: Frame) -> np.ndarray:
        """Colours (h, w, 3) uint8."""
        return self._cameras[frame.camera].rgb(frame.i)

    def _depth(self, frame: Frame) -> np.ndarray:
        """z-depth (h, w) float32 metres; 0 where it is unknown."""
        if self.truth is not None:
            return self.truth.depth(frame.camera, frame.i)
        return self._cameras[frame.camera].depth(frame.i)

    def _labels(self, frame: Frame) -> np.ndarray:
        """Labels (h, w) uint8: ground truth, or else instances of the masks; 0 is background."""
        if self.truth is not None:
            return self.truth.instance(frame.camera, frame.i)
        return self.masks.camera(frame.camera).instance(frame.i)

    def world_from_camera(self, frame: Frame) -> np.ndarray:
        """The transform (4, 4) of a frame: ground truth, or else as recorded."""
        return self._world_from_cameras[frame.camera][frame.i]

    @cached_property
    def _world_from_cameras(self) -> dict[str, np.ndarray]:
        if self.truth is not None:
            return {name: self.truth.world_from_cameras(name) for name in self.cameras}
        return {name: self._cameras[name].world_from_cameras for name in self.cameras}

    @cached_property
    def objects(self) -> dict[int, str]:
        """Names of objects by label. Instances of masks have that of their identity, or a number in their scene."""
        if self.truth is not None:
            return {label: name for label, name in sorted(self.truth.label_names.items()) if label not in (0, ROBOT)}
        names = identity_names(self._dataset)
        return {i: names.get((self.scene, i), f"{self.scene} {i}") for i in range(1, self.masks.n_instances + 1)}

    def points(self, frame: Frame, label: int, n: int) -> np.ndarray:
        """Up to n points (m, 3) of an object's visible surface, evenly over its pixels, metres, world frame."""
        import numpy as np

        from bask_data.core.geometry import transform, unproject

        depth = self.depth(frame)
        v, u = np.nonzero((self.labels(frame) == label) & (depth > 0))
        chosen = np.linspace(0, len(u) - 1, min(n, len(u))).round().astype(int)
        u, v = u[chosen], v[chosen]
        camera = unproject(np.stack([u, v], axis=1).astype(float), depth[v, u].astype(float), self.K(frame))
        return transform(self.world_from_camera(frame), camera)
