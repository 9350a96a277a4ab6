from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bask_data.core.correspondences import frame_pairs
from bask_data.core.correspondences.frame_pairs import candidates, choose_pairs, overlap, view_class
from bask_data.core.geometry import view_change
from tests import scenes

K = scenes.intrinsics(120, 160)


def ball(n=400):
    """Points of a sphere of 5 cm at the origin and their normals, spread evenly."""
    i = np.arange(n) + 0.5
    z, angle = 1 - 2 * i / n, np.pi * (1 + 5**0.5) * i
    normals = np.stack([np.sqrt(1 - z**2) * np.cos(angle), np.sqrt(1 - z**2) * np.sin(angle), z], axis=1)
    return 0.05 * normals, normals


def seen(cameras):
    points, normals = ball()
    return frame_pairs.seen(points, normals, np.tile(K, (len(cameras), 1, 1)), cameras, 120, 160), points


def test_a_frame_sees_with_its_own_intrinsics():
    camera, (points, normals) = scenes.look_at((0.0, 0.0, 0.5)), ball()
    away = K + np.array([[0, 0, 400.0], [0, 0, 0], [0, 0, 0]])
    first, second = frame_pairs.seen(points, normals, np.stack([K, away]), np.stack([camera, camera]), 120, 160)
    assert first.any() and not second.any()


def test_a_camera_sees_the_half_of_a_ball_that_faces_it():
    [shown], points = seen(scenes.look_at((0.0, 0.0, 0.5))[None])
    assert shown[points[:, 2] > 0.03].all()
    assert not shown[points[:, 2] < 0.005].any()
    [away], _ = seen(scenes.look_at((0.0, 0.0, 0.5), (0.0, 0.0, 1.0))[None])
    assert not away.any()


def test_overlap_is_shared_over_either():
    is_seen = np.array([[1, 1, 0, 0], [0, 1, 1, 0], [0, 0, 0, 0]], bool)
    a, b = np.array([0, 0, 2, 0]), np.array([1, 0, 2, 2])
    np.testing.assert_allclose(overlap(is_seen, a, b), [1 / 3, 1.0, 0.0, 0.0])


@settings(max_examples=10)
@given(seed=st.integers(0, 2**32 - 1))
def test_every_pair_changes_view_and_shares_surface(seed):
    cameras = scenes.orbit(25)
    is_seen, points = seen(cameras)
    pairs = choose_pairs(cameras, is_seen, points, 60, np.random.default_rng(seed))
    assert len(pairs.frames) == 60
    a, b = pairs.frames.T
    distance, angle = view_change(cameras[a], cameras[b])
    np.testing.assert_array_equal(pairs.distance, distance)
    np.testing.assert_array_equal(pairs.angle, angle)
    assert ((distance > 0.2) | (angle > np.deg2rad(20))).all()
    assert (overlap(is_seen, a, b) >= 0.15).all()
    assert len({frozenset(pair) for pair in pairs.frames.tolist()}) == 60
    assert (np.diff(a) >= 0).all()


def test_the_angle_alone_makes_a_pair():
    """Cameras at one place that turn: radians and degrees mixed up would never let these through."""
    turned = scenes.look_at((0.0, 0.0, 0.5))[None].repeat(2, axis=0)
    c, s = np.cos(np.deg2rad(25)), np.sin(np.deg2rad(25))
    turned[1, :3, :3] = turned[1, :3, :3] @ [[c, -s, 0], [s, c, 0], [0, 0, 1]]
    is_seen, points = seen(turned)
    one = choose_pairs(turned, is_seen, points, 5, np.random.default_rng(0))
    assert len(one.frames) == 1
    assert one.angle[0] == pytest.approx(np.deg2rad(25))
    none = choose_pairs(turned, is_seen, points, 5, np.random.default_rng(0), min_angle=np.deg2rad(26))
    assert (len(none.frames), none.n_looked_at, none.n_too_similar) == (0, 1, 1)


def test_opposite_views_share_too_little_and_are_counted():
    cameras = np.stack([scenes.look_at((0.5, 0.0, 0.0)), scenes.look_at((-0.5, 0.0, 0.0))])
    is_seen, points = seen(cameras)
    pairs = choose_pairs(cameras, is_seen, points, 5, np.random.default_rng(0))
    assert (len(pairs.frames), pairs.n_too_similar, pairs.n_too_little_overlap) == (0, 0, 1)


def test_pairs_are_spread_over_angles_scales_and_frames():
    near, far = scenes.orbit(20, radius=0.4), scenes.orbit(20, radius=0.8)
    cameras = np.concatenate([near, far])
    is_seen, points = seen(cameras)
    pairs = choose_pairs(cameras, is_seen, points, 80, np.random.default_rng(0), min_overlap=0.05)
    a, b = pairs.frames.T
    assert np.unique(pairs.frames).size == 40
    assert np.bincount(pairs.frames.ravel()).max() <= 3 * 80 * 2 / 40
    n_scale = np.bincount(((a >= 20).astype(int) - (b >= 20)) + 1, minlength=3)
    assert n_scale.min() >= 20
    group = view_class(cameras, is_seen, points, a, b)
    every_a, every_b = candidates(40, np.random.default_rng(0))
    usable = overlap(is_seen, every_a, every_b) >= 0.05
    distance, angle = view_change(cameras[every_a], cameras[every_b])
    usable &= (distance > 0.2) | (angle > np.deg2rad(20))
    all_groups = np.unique(view_class(cameras, is_seen, points, every_a[usable], every_b[usable]))
    assert len(np.unique(group)) >= 0.8 * len(all_groups)


def test_a_turn_about_the_viewing_axis_is_its_own_class():
    cameras = np.stack([scenes.look_at((0.0, 0.1, 0.5)), scenes.look_at((0.1, 0.0, 0.5), up=(0.0, 1.0, 0.0))])
    is_seen, points = seen(cameras)
    same = view_class(cameras, is_seen, points, np.array([0]), np.array([0]))
    turned = view_class(cameras, is_seen, points, np.array([0]), np.array([1]))
    assert same[0] != turned[0]


def test_a_long_scan_is_sampled(monkeypatch):
    monkeypatch.setattr(frame_pairs, "MAX_CANDIDATES", 500)
    a, b = candidates(200, np.random.default_rng(0))
    assert 400 < len(a) <= 500
    assert (a != b).all()
    assert len({frozenset(pair) for pair in zip(a.tolist(), b.tolist(), strict=True)}) == len(a)


@pytest.mark.parametrize("n_frames", [0, 1, 2])
def test_few_frames_and_no_surface_give_no_pairs(n_frames):
    cameras = scenes.orbit(3)[:n_frames]
    nothing = np.zeros((0, 3))
    pairs = choose_pairs(cameras, np.zeros((n_frames, 0), bool), nothing, 5, np.random.default_rng(0))
    assert pairs.frames.shape == (0, 2)


def test_same_seed_same_pairs():
    cameras = scenes.orbit(25)
    is_seen, points = seen(cameras)
    one, two = (choose_pairs(cameras, is_seen, points, 60, np.random.default_rng(7)) for _ in range(2))
    np.testing.assert_array_equal(one.frames, two.frames)
