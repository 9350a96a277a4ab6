"""Ray-cast recordings of a table, with the faults of sensors, poses and stamps put into them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import cv2
import numpy as np

from bask_data.doctor.recording_checks import sensor_findings
from bask_data.findings import Finding
from tests.scenes import Plane, Scene, intrinsics, look_at, noisy, tabletop

HEIGHT, WIDTH = 120, 160


@dataclass(frozen=True)
class Recorded:
    """A camera's frames in memory."""

    rgb: np.ndarray
    depth: np.ndarray
    Ks: np.ndarray
    world_from_cameras: np.ndarray
    time: np.ndarray

    def findings(self, **settings: int) -> list[Finding]:
        """What the doctor says of it."""
        read = self.frame
        n = len(self.rgb)
        return sensor_findings("table/wrist", n, read, self.Ks, self.world_from_cameras, self.time, **settings)

    def frame(self, i: int) -> tuple[np.ndarray, np.ndarray]:
        """Colour and depth of a frame."""
        return self.rgb[i], self.depth[i]

    @property
    def codes(self) -> list[str]:
        """The codes of its findings."""
        return sorted({finding.code for finding in self.findings()})


@cache
def clean(
    n_frames: int = 16, seed: int = 0, noise: float = 0.003, arc_deg: float = 35.0, n_turns_back: int = 0
) -> Recorded:
    """A camera on an arc around a table with objects.

    Args:
        noise: standard deviation of depth, relative to it.
        n_turns_back: times that the camera swings back over its arc.
    """
    rng = np.random.default_rng(seed)
    scene = tabletop(6, seed)
    walls = (Plane(), Plane((0.0, 1.0, 0.0), 0.6), Plane((1.0, 0.0, 0.0), 0.7))
    scene = Scene(scene.objects, walls)
    way = np.linspace(0, 1 + n_turns_back, n_frames)
    azimuth = np.radians(20 + arc_deg * np.abs((way + 1) % 2 - 1))
    eyes = np.stack([0.7 * np.cos(azimuth), 0.7 * np.sin(azimuth), 0.45 + 0.05 * np.sin(3 * way)], axis=1)
    poses = np.stack([look_at(eye, (0.0, 0.0, 0.05)) for eye in eyes])
    K = intrinsics(HEIGHT, WIDTH)
    views = [scene.render(K, pose, HEIGHT, WIDTH) for pose in poses]
    depth = np.stack([_measured(view.depth, noise, rng) for view in views])
    # Grain, as no real image is the same twice.
    rgb = np.stack([view.rgb + rng.normal(0, 2, view.rgb.shape) for view in views])
    time = np.arange(n_frames) / 10.0
    return Recorded(np.clip(rgb, 0, 255).astype(np.uint8), depth, np.tile(K, (n_frames, 1, 1)), poses, time)


def _measured(depth: np.ndarray, noise: float, rng: np.random.Generator) -> np.ndarray:
    """Depth in whole millimetres, with noise in proportion to it and some holes."""
    holes = cv2.resize(rng.random((12, 16)), (WIDTH, HEIGHT)) < 0.15
    values = noisy(depth, 0.0, rng) * (1 + noise * rng.normal(size=depth.shape))
    return np.where(holes, 0, np.round(values * 1000) / 1000).astype(np.float32)


def with_depth(recorded: Recorded, change: Callable[[int, np.ndarray], np.ndarray]) -> Recorded:
    """The recording with each depth image changed."""
    changed = [change(i, depth.copy()) for i, depth in enumerate(recorded.depth)]
    return replace(recorded, depth=np.stack(changed).astype(np.float32))


def with_rgb(recorded: Recorded, change: Callable[[int, np.ndarray], np.ndarray]) -> Recorded:
    """The recording with each colour image changed."""
    changed = [change(i, rgb.copy()) for i, rgb in enumerate(recorded.rgb)]
    return replace(recorded, rgb=np.clip(np.stack(changed), 0, 255).astype(np.uint8))


def moved_by(shift_mm: float, turn_deg: float) -> np.ndarray:
    """A rigid error of a pose, oblique to all axes."""
    error = np.eye(4)
    error[:3, :3] = cv2.Rodrigues(np.radians(turn_deg) * np.array([0.6, -0.64, 0.48]))[0]
    error[:3, 3] = shift_mm / 1000 * np.array([0.48, 0.6, 0.64])
    return error


def with_errors(recorded: Recorded, errors: dict[int, np.ndarray]) -> Recorded:
    """The recording with errors of the poses of some frames."""
    poses = recorded.world_from_cameras.copy()
    for i, error in errors.items():
        poses[i] = poses[i] @ error
    return replace(recorded, world_from_cameras=poses)
