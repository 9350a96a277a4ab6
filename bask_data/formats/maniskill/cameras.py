"""Cameras of a ManiSkill trajectory: images of `obs/sensor_data` and calibration of `obs/sensor_param`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Integer
from numpy import ndarray

from bask_data.core.geometry import invert_rigid
from bask_data.core.lens import Lens
from bask_data.errors import BadData
from bask_data.formats.hdf5 import Hdf5File, StoredFrames
from bask_data.formats.poses import OPENCV_FROM_OPENGL
from bask_data.formats.recording import Depth, SourceCamera
from bask_data.formats.simulated import at_pixel_centres, labelled

SAME_POSE = 1e-3
"""Largest difference of the two statements of one pose, metres or of a rotation's entries: rounding of float32 of a
camera 10 m away is 1e-6."""


@dataclass(frozen=True)
class ImageGroups:
    """Groups of a version: of images and of calibration in `obs`, and metres per unit of integer depth."""

    images: str
    calibration: str
    depth_scale: float


LAYOUTS = (ImageGroups("sensor_data", "sensor_param", 0.001), ImageGroups("image", "camera_param", 1 / 1024))
"""Versions 3 and 2."""


def unusable(file: Hdf5File, observations: str, layout: ImageGroups) -> dict[str, str]:
    """For each camera why it cannot be used; empty if it can."""
    reasons = {}
    for camera in file.members(f"{observations}/{layout.images}"):
        images = f"{observations}/{layout.images}/{camera}"
        calibration = f"{observations}/{layout.calibration}/{camera}"
        there = file.members(images) if file.is_group(images) else []
        lacking = [kind for kind in ("rgb", "depth") if kind not in there]
        known = file.members(calibration) if file.is_group(calibration) else []
        lacking += [] if "intrinsic_cv" in known else ["intrinsic_cv"]
        lacking += [] if {"extrinsic_cv", "cam2world_gl"} & set(known) else ["cam2world_gl or extrinsic_cv"]
        reason = f"no {', '.join(lacking)}" if lacking else ""
        if "Color" in there:
            reason += ": raw Color and Position; replay it with --obs-mode rgbd"
        reasons[camera] = reason
    return reasons


class ManiskillCamera:
    """One camera of a trajectory."""

    def __init__(self, file: Hdf5File, observations: str, layout: ImageGroups, name: str) -> None:
        self.name, self._file, self._layout = name, file, layout
        images = f"{observations}/{layout.images}/{name}"
        self._calibration = f"{observations}/{layout.calibration}/{name}"
        self._color = file.color(f"{images}/rgb")
        n_frames, height, width, _ = self._color.shape
        self._depth = file.frames(f"{images}/depth", (n_frames, height, width, 1), "iuf")
        self.numbers: StoredFrames | None = None
        if file.has(f"{images}/segmentation"):
            self.numbers = file.frames(f"{images}/segmentation", (n_frames, height, width, 1), "iu")
        K = file.array(f"{self._calibration}/intrinsic_cv", (n_frames, 3, 3)).astype(np.float64)
        self._K, self.about_K = at_pixel_centres(K, (height, width))

    def read(self, fps: float, objects: dict[int, tuple[int, str]]) -> SourceCamera:
        n_frames, height, width, _ = self._color.shape
        is_float = self._depth.dtype.kind == "f"
        return SourceCamera(
            name=self.name,
            frames=tuple(map(str, range(n_frames))),
            lens=Lens(self._K, (height, width)),
            world_from_cameras=self._poses(n_frames),
            time=np.arange(n_frames) / fps,
            color=self._color,
            depth=_metres(self._depth) if is_float else _units(self._depth),
            depth_scale=1.0 if is_float else self._layout.depth_scale,
            labels=labelled(_flat(self.numbers), objects) if self.numbers is not None and objects else None,
            pose_places=tuple(f"{self._file.path}: {self._calibration} frame {i}" for i in range(n_frames)),
        )

    def _poses(self, n_frames: int) -> Float[ndarray, "t 4 4"]:
        """world_from_camera of both statements of it, which must agree where both are there."""
        gl = cv = None
        if self._file.has(place := f"{self._calibration}/cam2world_gl"):
            gl = self._file.array(place, (n_frames, 4, 4)).astype(np.float64) @ OPENCV_FROM_OPENGL
        if self._file.has(place := f"{self._calibration}/extrinsic_cv"):
            n_rows = self._file.shape(place)[1:2]
            stored = self._file.array(place, (n_frames, 4 if n_rows == (4,) else 3, 4)).astype(np.float64)
            cv = np.tile(np.eye(4), (n_frames, 1, 1))
            cv[:, : stored.shape[1]] = stored
            cv = invert_rigid(cv)
        if gl is None or cv is None:
            found = cv if gl is None else gl
            assert found is not None
            return found
        apart = np.abs(gl - cv).max(axis=(1, 2))
        if (apart > SAME_POSE).any():
            raise BadData(
                self._file.path,
                f"{self._calibration} frame {int(np.argmax(apart > SAME_POSE))}",
                expected="cam2world_gl and extrinsic_cv of the same pose",
                got=f"a difference of {apart.max():.3g}",
                fix="replay the trajectory with a current version of ManiSkill.",
            )
        return gl


def _flat(frames: StoredFrames) -> Callable[[int], Integer[ndarray, "h w"]]:
    return lambda i: frames(i)[..., 0]


def _units(frames: StoredFrames) -> Callable[[int], Depth]:
    # Beyond 32.767 m the simulator's 16 bits with sign wrap around.
    return lambda i: np.clip(frames(i)[..., 0], 0, 2**16 - 1).astype(np.uint16)


def _metres(frames: StoredFrames) -> Callable[[int], Depth]:
    return lambda i: frames(i)[..., 0].astype(np.float32)
