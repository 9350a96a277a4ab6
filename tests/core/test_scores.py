from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bask_data.core.geometry import invert_rigid, project, transform, unproject
from bask_data.core.label_overlap import best_instances, joined, overlap, paired_instances
from bask_data.core.landings import OUTSIDE, label_at, landing
from bask_data.core.match_errors import TrueView, match_errors, true_depth
from bask_data.core.scores import distribution
from bask_data.core.track_scores import object_shares, spread, step_length
from tests import scenes

SEEDS = st.integers(0, 2**32 - 1)


def rigid(rng: np.random.Generator) -> np.ndarray:
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    result = np.eye(4)
    result[:3, :3] = rotation * np.sign(np.linalg.det(rotation))
    result[:3, 3] = rng.normal(size=3)
    return result


def test_distribution_counts_finite_values_only():
    found = distribution(np.array([[1.0, np.nan], [np.inf, 3.0]]))
    assert (found.n, found.median, found.mean, found.largest) == (2, 2.0, 2.0, 3.0)


def test_distribution_of_nothing_is_nan_and_counts_zero():
    found = distribution(np.array([np.nan]))
    assert found.n == 0
    assert np.isnan([found.median, found.mean, found.p90, found.largest]).all()


def test_labels_that_touch_directly_or_through_others_become_their_smallest():
    lut = joined([(7, 3), (9, 7), (20, 21)])
    assert lut[[3, 7, 9]].tolist() == [3, 3, 3]
    assert lut[[20, 21]].tolist() == [20, 20]
    alone = np.setdiff1d(np.arange(256), [7, 9, 21])
    np.testing.assert_array_equal(lut[alone], alone)


def test_nothing_that_touches_changes_no_label():
    np.testing.assert_array_equal(joined([]), np.arange(256))


def test_an_instance_over_two_labels_is_given_to_one_of_them():
    labels = np.array([[1, 1, 1, 2, 2]], np.uint8)
    pairs = paired_instances(overlap(labels, np.ones_like(labels)))
    assert [(pair.label, pair.instance) for pair in pairs] == [(1, 1), (2, 0)]
    assert [pair.iou for pair in pairs] == [3 / 5, 0.0]


def test_pairs_have_the_largest_sum_of_iou():
    rng = np.random.default_rng(0)
    labels, instances = (rng.integers(0, 5, (12, 12)).astype(np.uint8) for _ in range(2))
    table = overlap(labels, instances)
    pairs = paired_instances(table)
    iou = lambda label, one: table[label, one] / (table[label].sum() + table[:, one].sum() - table[label, one])  # noqa: E731
    best = max(sum(iou(i + 1, one) for i, one in enumerate(order)) for order in itertools.permutations(range(1, 5)))
    assert sum(pair.iou for pair in pairs) == pytest.approx(best)


@given(SEEDS)
def test_iou_is_that_of_counting_sets_of_pixels(seed):
    rng = np.random.default_rng(seed)
    labels = rng.choice(np.array([0, 7, 200], np.uint8), size=(2, 6, 5))
    instances = rng.integers(0, 4, size=(2, 6, 5)).astype(np.uint8)
    matches = best_instances(sum(overlap(a, b) for a, b in zip(labels, instances, strict=True)))
    assert [match.label for match in matches] == sorted(set(np.unique(labels)) - {0})
    for match in matches:
        iou = {
            i: ((labels == match.label) & (instances == i)).sum() / ((labels == match.label) | (instances == i)).sum()
            for i in range(1, 4)
            if (instances == i).any()
        }
        assert match.iou == pytest.approx(max(iou.values(), default=0.0))
        assert match.n_pixels == (labels == match.label).sum()
        if match.iou > 0:
            assert iou[match.instance] == pytest.approx(match.iou)
        else:
            assert match.instance == 0


def test_equal_images_have_iou_one_whatever_the_ids_are_called():
    labels = np.array([[0, 3, 3], [9, 9, 0]], np.uint8)
    renamed = np.array([[0, 2, 2], [1, 1, 0]], np.uint8)
    assert [(m.label, m.instance, m.iou) for m in best_instances(overlap(labels, renamed))] == [
        (3, 2, 1.0),
        (9, 1, 1.0),
    ]


def test_a_label_on_background_only_has_no_instance():
    [match] = best_instances(overlap(np.full((2, 2), 5, np.uint8), np.zeros((2, 2), np.uint8)))
    assert (match.instance, match.iou) == (0, 0.0)


def test_label_is_that_of_the_nearest_pixel_and_outside_beyond_the_edge():
    labels = np.array([[1, 2], [3, 4]], np.uint8)
    pixel = np.array([[0.4, 0.4], [0.6, 0.4], [-0.4, 1.4], [1.6, 0.0], [np.nan, 0.0], [1e9, 1e9]])
    assert label_at(labels, pixel).tolist() == [1, 2, 3, OUTSIDE, OUTSIDE, OUTSIDE]


@given(SEEDS, st.floats(0, 6))
def test_near_is_the_distance_to_the_closest_pixel_of_the_object(seed, tolerance):
    rng = np.random.default_rng(seed)
    labels = (rng.random((9, 12)) < 0.05).astype(np.uint8) * 3
    pixel = rng.uniform(-4, 14, size=(20, 2))
    found = landing(pixel, np.full(20, 3), labels, tolerance)
    v, u = np.nonzero(labels == 3)
    if not len(u):
        assert not found.in_view.any()
        assert not found.near.any()
        return
    distance = np.hypot(pixel[:, :1] - u, pixel[:, 1:] - v).min(axis=1)
    assert found.in_view.all()
    assert (found.near == (found.exact | (distance <= tolerance))).all()
    assert found.chance == pytest.approx(len(u) / labels.size)


def test_landing_says_right_other_background_outside_and_skips_objects_out_of_view():
    labels = np.zeros((4, 6), np.uint8)
    labels[:, :2], labels[:, 4:] = 1, 2
    pixel = np.array([[0, 0], [5, 0], [3, 0], [99, 0], [np.nan, 0], [0, 0], [0, 0]], float)
    found = landing(pixel, np.array([1, 1, 1, 1, 1, 7, 0]), labels, 1.0)
    assert found.in_view.tolist() == [True] * 5 + [False, False]
    assert found.exact.tolist() == [True] + [False] * 6
    shares = object_shares([found])
    assert shares.n == 5
    assert (shares.right, shares.other, shares.background, shares.outside) == (0.2, 0.2, 0.2, 0.4)
    assert shares.chance == pytest.approx(1 / 3)


def test_shares_of_chosen_keypoints_are_theirs_alone():
    labels = np.array([[1, 1, 0]], np.uint8)
    frames = [landing(np.array([[0.0, 0], [2.0, 0]]), np.array([1, 1]), labels, 0.0)] * 3
    assert object_shares(frames, np.array([True, False])).right == 1.0
    assert object_shares(frames, np.array([False, True])).right == 0.0
    assert object_shares(frames, np.array([False, False])).n == 0
    assert object_shares([]).n == 0


def test_a_negative_tolerance_is_refused():
    with pytest.raises(ValueError, match="tolerance_px: expected >= 0 pixels, got -1"):
        landing(np.zeros((1, 2)), np.array([1]), np.ones((2, 2), np.uint8), -1.0)


def test_spread_is_the_root_mean_square_distance_of_samples_from_their_mean():
    samples = np.random.default_rng(0).normal(size=(1000, 3)) * [0.01, 0.02, 0.05]
    rms = np.sqrt(((samples - samples.mean(axis=0)) ** 2).sum(axis=1).mean())
    assert spread(np.cov(samples.T, bias=True)[None, None]) == pytest.approx(rms)


def test_step_is_how_far_the_mean_moved():
    mean = np.cumsum(np.array([[[0.0, 0, 0]], [[3.0, 4, 0]], [[0.0, 0, 2]]]), axis=0).astype(np.float32)
    assert step_length(mean)[:, 0].tolist() == [5.0, 2.0]


HEIGHT, WIDTH = 60, 80
K = scenes.intrinsics(HEIGHT, WIDTH)
WALL = scenes.Plane(normal=(0.0, 0.6, 0.8), offset=-0.02)
POST = scenes.Box((0.01, 0.15, 0.01), scenes.look_at((0.0, 0.0, 0.2), (0.0, 0.0, 1.0)))


def two_views(objects=()):
    """A slanted wall from two places, with what may stand in front of it."""
    scene = scenes.Scene(tuple(objects), (WALL,))
    cameras = [scenes.look_at((x, 0.1, 0.6), (x / 2, 0.0, 0.0), up=(0.0, 1.0, 0.0)) for x in (-0.1, 0.15)]
    return [scene.render(K, camera, HEIGHT, WIDTH) for camera in cameras], cameras


def true_views(views, cameras):
    return [TrueView(view.depth, view.instance, K, camera) for view, camera in zip(views, cameras, strict=True)]


@given(SEEDS)
def test_error_is_the_distance_to_where_a_formula_says_the_point_is(seed):
    (a, b), cameras = two_views()
    rng = np.random.default_rng(seed)
    uv_a = rng.uniform(0, [WIDTH - 1, HEIGHT - 1], size=(20, 2))
    z = WALL.cast(cameras[0][:3, 3], unproject(uv_a, np.ones(20), K) @ cameras[0][:3, :3].T)
    assert true_depth(a.depth, a.instance, uv_a) == pytest.approx(z, abs=1e-6)
    b_from_a = invert_rigid(cameras[1]) @ cameras[0]
    uv_b, z_b = project(transform(b_from_a, unproject(uv_a, z, K)), K)
    off = rng.normal(scale=2, size=(20, 2))
    found = match_errors(uv_a, uv_b + off, *true_views((a, b), cameras))
    assert found.error_px == pytest.approx(np.linalg.norm(off, axis=1), abs=1e-3)
    assert found.depth == pytest.approx(z_b, abs=1e-5)
    assert not found.hidden((0.01, 0.0)).any()


def test_a_point_behind_a_post_is_hidden_however_right_the_match_is():
    (a, b), cameras = two_views([POST])
    uv_a = np.stack(np.nonzero(a.instance == 0)[::-1], axis=1).astype(float)
    z = true_depth(a.depth, a.instance, uv_a)
    assert z == pytest.approx(a.depth[a.instance == 0], abs=1e-6)
    uv_b, _ = project(transform(invert_rigid(cameras[1]) @ cameras[0], unproject(uv_a, z, K)), K)
    found = match_errors(uv_a, uv_b, *true_views((a, b), cameras))
    behind_post = label_at(b.instance, uv_b) == 1
    assert behind_post.sum() > 50
    np.testing.assert_array_equal(found.hidden(), behind_post)
    assert (found.behind[behind_post] > 0.03).all()
    assert not found.hidden((1.0, 0.0)).any()
    assert found.error_px == pytest.approx(0, abs=1e-6)


def test_true_depth_mixes_neither_bodies_nor_surfaces_of_one_body():
    depth = np.array([[1.0, 1.0, 2.0, 2.0], [1.0, 1.0, 2.0, 0.0]], np.float32)
    labels = np.array([[1, 2, 2, 2], [1, 2, 2, 2]], np.uint8)
    uv = np.array([[0.4, 0.5], [1.4, 0.2], [1.6, 0.2], [2.9, 0.9], [-0.6, 0.0], [np.nan, 0.0]])
    assert true_depth(depth, labels, uv).tolist() == [1.0, 1.0, 2.0, 0.0, 0.0, 0.0]


def test_a_match_on_nothing_is_infinitely_wrong_and_one_that_leaves_the_image_is_not_hidden():
    depth = np.full((HEIGHT, WIDTH), 0.5, np.float32)
    depth[0, 0] = 0.0
    away = np.eye(4)
    away[:3, 3] = [1.0, 0.0, 0.0]
    behind = np.eye(4)
    behind[:3, 3] = [0.0, 0.0, 1.0]
    uv = np.array([[0.0, 0.0], [40.0, 30.0]])
    labels = np.zeros((HEIGHT, WIDTH), np.uint8)
    found = match_errors(uv, uv, TrueView(depth, labels, K, np.eye(4)), TrueView(depth, labels, K, away))
    assert np.isinf(found.error_px[0])
    assert np.isnan(found.depth[0])
    assert np.isfinite(found.error_px[1])
    assert not found.hidden((0.0, 0.0)).any()
    assert np.isinf(
        match_errors(uv, uv, TrueView(depth, labels, K, np.eye(4)), TrueView(depth, labels, K, behind)).error_px
    ).all()
