"""Ray-cast scenes seen along different motions, with errors of the poses."""

from __future__ import annotations

from functools import cache

import numpy as np

from bask_data.core.geometry import invert_rigid
from bask_data.core.pair_alignment import moved
from tests.scenes import intrinsics, look_at, noisy, tabletop

HEIGHT, WIDTH, N_FRAMES = 120, 160, 14
K = intrinsics(HEIGHT, WIDTH)
SCENE = tabletop(9, seed=4)
HAND_EYE = moved(np.array([0.02, -0.025, 0.015, 0.006, -0.005, 0.006]))
"""10 mm and 2 degrees."""


def orbiting() -> np.ndarray:
    """Around the table, up and down, turned about the optical axis."""
    poses = []
    for s in np.linspace(0, 1, N_FRAMES):
        azimuth, elevation, roll = 4.5 * s, 0.9 + 0.35 * np.sin(9 * s), 0.5 * np.sin(7 * s)
        eye = (0.6 + 0.08 * np.sin(11 * s)) * np.array(
            [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
        )
        poses.append(look_at(eye, (0.03 * np.sin(5 * s), 0, 0)) @ moved(np.array([0, 0, roll, 0, 0, 0])))
    return np.stack(poses)


def sideways() -> np.ndarray:
    """Along the table without turning."""
    poses = np.stack([look_at((0.0, -0.4, 0.5))] * N_FRAMES)
    poses[:, 0, 3] += np.linspace(-0.12, 0.12, N_FRAMES)
    poses[:, 1, 3] += 0.05 * np.sin(np.linspace(0, 6, N_FRAMES))
    return poses


def about_one_axis() -> np.ndarray:
    """Around the vertical, always from the same height."""
    angles = np.linspace(0, 2.5, N_FRAMES)
    return np.stack([look_at((0.45 * np.cos(a), 0.45 * np.sin(a), 0.45), (0, 0, 0)) for a in angles])


@cache
def _depth(motion: str) -> tuple[np.ndarray, ...]:
    rng = np.random.default_rng(0)
    return tuple(noisy(SCENE.render(K, pose, HEIGHT, WIDTH).depth, 0.001, rng) for pose in MOTIONS[motion]())


MOTIONS = {"orbiting": orbiting, "sideways": sideways, "about_one_axis": about_one_axis}


def recorded(motion: str) -> tuple[list[np.ndarray], np.ndarray]:
    """Depth of the frames, metres, and true world_from_cameras."""
    return list(_depth(motion)), MOTIONS[motion]()


def with_hand_eye_error(poses: np.ndarray) -> np.ndarray:
    """The poses as given with `HAND_EYE`: true = given @ HAND_EYE."""
    return poses @ invert_rigid(HAND_EYE)


def drifting(poses: np.ndarray) -> np.ndarray:
    """The poses with an error that grows to 3 cm and 1.5 degrees."""
    turn = np.radians(1.5) * np.array([0.6, 0.0, 0.8])
    return np.stack(
        [pose @ moved(s * np.r_[turn, 0.03 * np.array([0.7, -0.5, 0.5])]) for s, pose in enumerate_share(poses)]
    )


def enumerate_share(poses: np.ndarray) -> list[tuple[float, np.ndarray]]:
    """Each pose with its place in the recording, from 0 to 1."""
    return list(zip(np.linspace(0, 1, len(poses)).tolist(), poses, strict=True))
