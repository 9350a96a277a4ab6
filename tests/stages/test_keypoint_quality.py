from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from bask_data.core.agreement import Sightings
from bask_data.core.geometry import invert_rigid, transform
from bask_data.nn.recognition import Search
from bask_data.stages.keypoint_quality import LEAST_SEEN, MOST_SCANS, Pool, elsewhere, in_own_scan, other_scans
from tests.core.test_rigid_fit import motion
from tests.nn.test_selection import position_views


def pool_of(views, points, there_from_here: np.ndarray) -> Pool:
    """Points of the first view, as picked in a scan in which everything lies elsewhere."""
    chosen = points[0].reshape(-1, 3)[::97]
    descriptors = torch.from_numpy(chosen).float()
    own = Search.of(descriptors, views[:0]).sightings(chosen)
    return Pool(transform(there_from_here, chosen), descriptors, own)


def test_other_scans_come_in_the_order_of_what_was_not_learned_from():
    assert other_scans("b", ["a", "b", "c", "d"], ("a", "b", "c")) == ["d", "a", "c"]
    assert other_scans("b", ["a", "b", "c"], None) == ["a", "c"]
    assert len(other_scans("b", [f"s{i}" for i in range(20)], ())) == MOST_SCANS


def test_an_object_is_found_where_it_was_moved_to_and_its_true_places_follow():
    views, points = position_views(5)
    pool = pool_of(views, points, motion(np.random.default_rng(5)))
    wrong = torch.arange(len(pool.points_world)) % 5 == 0
    # A fifth of the points are found at one wrong place, on which all views agree.
    pool.descriptors[wrong] = pool.descriptors[len(wrong) // 2].clone()
    seen = elsewhere(pool, views[1:], seed=0)
    assert seen is not None
    error = seen.expected_error
    shown = np.isfinite(error)
    assert np.median(error[shown & ~wrong.numpy()]) < 0.01
    assert np.median(error[shown & wrong.numpy()]) > 0.05


def test_an_object_that_the_other_scan_does_not_show_is_not_recognised():
    views, points = position_views(5)
    pool = pool_of(views, points, np.eye(4))
    pool.descriptors = torch.from_numpy(np.random.default_rng(0).normal(size=pool.descriptors.shape)).float()
    assert elsewhere(pool, views, seed=0) is None
    assert elsewhere(pool, views[:1], seed=0) is None
    assert pool.recognition(0, "a") is None


def test_an_object_whose_points_match_worse_than_in_its_own_scan_is_not_recognised():
    views, points = position_views(5)
    pool = pool_of(views, points, np.eye(4))
    # All match as well as before relative to each other, but from afar, as something small that resembles it would.
    far = [replace(view, descriptors=torch.cat([view.descriptors, 0 * view.descriptors[:1] + 0.5])) for view in views]
    pool.descriptors = torch.cat([pool.descriptors, torch.zeros(len(pool.descriptors), 1)], dim=1)
    assert elsewhere(pool, far[1:], seed=0) is not None
    pool.familiar = 0.1
    assert elsewhere(pool, far[1:], seed=0) is None


def test_what_is_stored_is_of_the_other_scans_and_else_of_its_own():
    views, points = position_views(5)
    pool = pool_of(views, points, np.eye(4))
    pool.own, pool.familiar = in_own_scan(
        pool.points_world, pool.descriptors, np.zeros(len(pool.points_world), int), views
    )
    # The first view is their own, so it does not count.
    assert np.isnan(pool.own.error[:, 0]).all()
    row = int(np.argmax(pool.own.n_views))
    own = pool.recognition(row, "a")
    assert own is not None
    assert (own.scans, own.n_frames, own.share_found) == (("a",), 4, 1.0)
    assert own.error == pytest.approx(pool.own.expected_error[row])
    seen = elsewhere(pool, views[3:], seed=0)
    assert seen is not None
    pool.scans, pool.others = ["b"], [seen]
    other = pool.recognition(row, "a")
    assert other is not None
    assert (other.scans, other.n_frames) == (("b",), int(seen.n_views[row]))


def test_moving_a_camera_and_its_points_alike_changes_nothing():
    views, points = position_views(3)
    pool = pool_of(views, points, np.eye(4))
    back = invert_rigid(motion(np.random.default_rng(1)))
    moved = pool_of(views, points, back)
    seen, same = elsewhere(pool, views, seed=3), elsewhere(moved, views, seed=3)
    assert seen is not None
    assert same is not None
    np.testing.assert_allclose(seen.expected_error, same.expected_error, atol=0.02)


def test_candidates_are_ranked_by_both_scans_and_what_few_frames_show_comes_last():
    def seen(*errors: float) -> Sightings:
        error = np.tile(np.array(errors)[:, None], (1, LEAST_SEEN))
        # The last candidate is right in all frames that show it, but these are too few.
        error[-1] = np.where(np.arange(LEAST_SEEN) < LEAST_SEEN - 1, 0.0, np.nan)
        return Sightings(error, np.zeros_like(error))

    own, other = seen(0.01, 0.02, 0.03, 0.0), seen(0.1, 0.3, 0.01, 0.0)
    pool = Pool(np.zeros((4, 3)), torch.zeros(4, 2), own, scans=["b"], others=[other])
    assert pool.ranks.tolist() == [0 + 1, 1 + 2, 2 + 0, 3 + 3]
    # Without another scan, its own decides.
    assert Pool(np.zeros((4, 3)), torch.zeros(4, 2), pool.own).ranks.tolist() == [0, 1, 2, 3]
