"""The truth that `benchmarks/doctor_statistics.py` compares answers with."""

from __future__ import annotations

import numpy as np
import pytest

from bask_data.core.readings_hypotheses import Hypothesis
from benchmarks.told_readings import (
    Told,
    Wrong,
    clock_is_right,
    intrinsics_are_right,
    reading_is_right,
    told,
    unit_is_right,
)
from tests.random_recordings import RandomRecording, random_recording

ANSWERS = [
    (Wrong(), Hypothesis()),
    (Wrong(inverted=True), Hypothesis(inverted=True)),
    (Wrong(opengl=True), Hypothesis(flipped=True)),
    (Wrong(inverted=True, opengl=True), Hypothesis(inverted=True, flipped=True)),
    (Wrong(mirrored=True), Hypothesis(mirrored=True)),
    (Wrong(reordered=True), Hypothesis(otherwise="--quat wxyz")),
    (Wrong(depth_factor=10.0), Hypothesis(depth_factor=0.1)),
    (Wrong(pose_factor=1000.0), Hypothesis(pose_factor=0.001)),
    (Wrong(pose_factor=1000.0), Hypothesis(depth_factor=1000.0)),
    (Wrong(K_factor=(0.5, 2 / 3)), Hypothesis(K_factor=(2.0, 1.5))),
    (Wrong(lag=2), Hypothesis(lag=-2)),
]


@pytest.fixture(scope="module")
def recording() -> RandomRecording:
    return random_recording(1, "hand", "table", n_frames=12)


def all_right(as_told: Told, answer: Hypothesis) -> bool:
    judges = (reading_is_right, unit_is_right, intrinsics_are_right, clock_is_right)
    return all(is_right(as_told, answer) for is_right in judges)


@pytest.mark.parametrize(("wrong", "answer"), ANSWERS, ids=str)
def test_the_answer_that_undoes_what_was_done_is_right_and_no_other(
    recording: RandomRecording, wrong: Wrong, answer: Hypothesis
) -> None:
    as_told = told(recording, wrong)
    right = [
        other for _, other in ANSWERS if not (other.otherwise and not wrong.reordered) and all_right(as_told, other)
    ]
    same_unit = [other for other in right if other.scale == answer.scale]
    assert answer in right
    assert same_unit == right


def test_a_camera_that_only_moves_sideways_makes_two_axes_right() -> None:
    exact = random_recording(2, "sideways", "table", n_frames=6)
    poses = np.tile(np.eye(4), (len(exact.world_from_cameras), 1, 1))
    poses[:, 0, 3] = np.linspace(0, 0.3, len(poses))
    as_told = told(RandomRecording("sideways", exact.raw, exact.depth_scale, exact.K, poses), Wrong())
    assert reading_is_right(as_told, Hypothesis(flipped=True))
    assert not reading_is_right(as_told, Hypothesis(inverted=True))


def test_rays_are_longer_than_z_at_the_corner(recording: RandomRecording) -> None:
    z = told(recording, Wrong()).read_depth(0)
    ray = told(recording, Wrong(is_ray=True)).read_depth(0)
    K = recording.K
    v, u = (axis[-1] for axis in np.nonzero(z))
    length = np.sqrt(1 + ((u - K[0, 2]) / K[0, 0]) ** 2 + ((v - K[1, 2]) / K[1, 1]) ** 2)
    assert ray[v, u] == pytest.approx(z[v, u] * length, rel=1e-5)
    assert length > 1.1
