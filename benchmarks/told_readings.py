"""Recordings told in a wrong way, and whether an answer about them is right: truth for `doctor_statistics.py`.

How a reading is undone is written here a second time, independent of what is measured.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Float32
from numpy import ndarray
from scipy.spatial.transform import Rotation

from bask_data.core.geometry import invert_rigid
from bask_data.core.readings_hypotheses import Hypothesis
from tests.random_recordings import RandomRecording

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
"""OpenCV from OpenGL axes of a camera, and the reverse."""
MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])
"""A left-handed world and camera."""

UNIT_TOLERANCE = np.log(1.12)
"""Logarithm of the factor within which a unit is right: as issue 15 has it."""


@dataclass(frozen=True)
class Wrong:
    """What is wrong with what is told.

    Args:
        inverted, opengl, mirrored, reordered: how poses are written, told as OpenCV world_from_camera, right-handed,
            with x y z w.
        depth_factor, pose_factor: told lengths per true one.
        K_factor: told intrinsics per true ones, along u and v.
        lag: frame i is told the pose of frame i + lag.
        is_ray: depth is the length of the ray, told as z.
    """

    inverted: bool = False
    opengl: bool = False
    mirrored: bool = False
    reordered: bool = False
    depth_factor: float = 1.0
    pose_factor: float = 1.0
    K_factor: tuple[float, float] = (1.0, 1.0)
    lag: int = 0
    is_ray: bool = False

    def __str__(self) -> str:
        right = Wrong()
        wrong = {name: value for name, value in vars(self).items() if value != getattr(right, name)}
        return ", ".join(f"{name} {value}" for name, value in wrong.items()) or "nothing wrong"


@dataclass(frozen=True)
class Told:
    """What is handed to the judge.

    Args:
        read_depth: metres of a frame.
        true_poses: those of `poses` under the right reading, told lengths, with the told lag.
    """

    n_frames: int
    read_depth: Callable[[int], Float32[ndarray, "h w"]]
    Ks: Float[ndarray, "t 3 3"]
    poses: Float[ndarray, "t 4 4"]
    true_poses: Float[ndarray, "t 4 4"]
    wrong: Wrong
    otherwise: dict[str, Float[ndarray, "t 4 4"]] = field(default_factory=dict)


def told(recording: RandomRecording, wrong: Wrong) -> Told:
    """The recording under a wrong reading."""
    return told_frames(
        recording.n_frames,
        lambda i: recording.raw[i] * np.float32(recording.depth_scale),
        np.tile(recording.K, (recording.n_frames, 1, 1)),
        recording.poses(wrong.lag),
        wrong,
    )


def told_frames(
    n_frames: int,
    read_depth: Callable[[int], Float32[ndarray, "h w"]],
    Ks: Float[ndarray, "t 3 3"],
    poses: Float[ndarray, "t 4 4"],
    wrong: Wrong,
) -> Told:
    """Frames under a wrong reading; a lag is that of `poses` already."""
    true_poses = poses.copy()
    true_poses[:, :3, 3] *= wrong.pose_factor
    written = true_poses
    if wrong.mirrored:
        written = MIRROR @ written @ MIRROR
    if wrong.opengl:
        written = written @ FLIP
    if wrong.inverted:
        written = invert_rigid(written)
    otherwise = {}
    if wrong.reordered:
        otherwise = {"--quat wxyz": written}
        written = _reordered(written)

    def depth(i: int) -> Float32[ndarray, "h w"]:
        there = read_depth(i) * np.float32(wrong.depth_factor)
        return there * _ray_length(there.shape, Ks[i]) if wrong.is_ray else there

    return Told(n_frames, depth, _scaled(Ks, wrong.K_factor), written, true_poses, wrong, otherwise)


def reading_is_right(told: Told, answer: Hypothesis) -> bool:
    """Whether direction, axes, handedness and order of the poses are those of the truth, or equal to them here."""
    poses = told.otherwise[answer.otherwise] if answer.otherwise else told.poses
    if answer.inverted:
        poses = invert_rigid(poses)
    if answer.flipped:
        poses = poses @ FLIP
    if answer.mirrored:
        poses = MIRROR @ poses @ MIRROR
    found, truth = _motions(poses), _motions(told.true_poses)
    # Only a left-handed reading mirrors motions; mirrored back they are to be the same.
    return bool(np.allclose(found, truth, atol=1e-6 * max(told.wrong.pose_factor, 1.0)))


def unit_is_right(told: Told, answer: Hypothesis) -> bool:
    """Whether depth in comparison with the poses is right, within 12 %."""
    wrong = told.wrong.depth_factor / told.wrong.pose_factor
    return bool(abs(np.log(answer.depth_factor / answer.pose_factor * wrong)) < UNIT_TOLERANCE)


def intrinsics_are_right(told: Told, answer: Hypothesis) -> bool:
    """Whether the intrinsics are right, within 12 %."""
    products = np.array(answer.K_factor) * np.array(told.wrong.K_factor)
    return bool((np.abs(np.log(products)) < UNIT_TOLERANCE).all())


def clock_is_right(told: Told, answer: Hypothesis) -> bool:
    """Whether the lag is right, to the frame."""
    return answer.lag == -told.wrong.lag


def _motions(poses: Float[ndarray, "t 4 4"]) -> Float[ndarray, "t 4 4"]:
    """Motion of the camera since the first frame, in its own frame: what depth can tell of poses."""
    return invert_rigid(poses[:1]) @ poses


def _scaled(Ks: Float[ndarray, "t 3 3"], factor: tuple[float, float]) -> Float[ndarray, "t 3 3"]:
    """Intrinsics for images of another size; the centre of the first pixel is 0."""
    scaled = Ks.copy()
    for axis, f in enumerate(factor):
        scaled[:, axis, axis] *= f
        scaled[:, axis, 2] = (scaled[:, axis, 2] + 0.5) * f - 0.5
    return scaled


def _ray_length(shape: tuple[int, ...], K: Float[ndarray, "3 3"]) -> Float32[ndarray, "h w"]:
    """Length of each pixel's ray per metre of z."""
    v, u = np.mgrid[: shape[0], : shape[1]]
    return np.sqrt(1 + ((u - K[0, 2]) / K[0, 0]) ** 2 + ((v - K[1, 2]) / K[1, 1]) ** 2).astype(np.float32)


def _reordered(poses: Float[ndarray, "t 4 4"]) -> Float[ndarray, "t 4 4"]:
    """Quaternions written w x y z and read as x y z w."""
    read = poses.copy()
    quat_wxyz = np.roll(Rotation.from_matrix(poses[:, :3, :3]).as_quat(), 1, axis=1)
    read[:, :3, :3] = Rotation.from_quat(quat_wxyz).as_matrix()
    return read
