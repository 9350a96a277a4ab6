from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.cluster import DBSCAN
from sklearn.metrics import adjusted_rand_score

from bask_data.core.clusters import dbscan


def boxes(rng, n_boxes, n_points, gap=0.045):
    """Points on the surfaces of boxes in a row, `gap` metres apart, and some specks around; the box of each, -1 for
    specks."""
    points, truth, x = [], [], 0.0
    for i_box in range(n_boxes):
        half = rng.uniform(0.02, 0.05, 3)
        unit = rng.uniform(-1, 1, (n_points, 3))
        face = rng.integers(3, size=n_points)
        unit[np.arange(n_points), face] = np.sign(unit[np.arange(n_points), face])
        points.append(unit * half + [x + half[0], 0, half[2]])
        truth.append(np.full(n_points, i_box))
        x += 2 * half[0] + gap
    specks = rng.uniform([0, 0.15, 0], [x, 0.5, 0.3], (20 * n_boxes, 3))
    return np.concatenate([*points, specks]), np.concatenate([*truth, np.full(len(specks), -1)])


def same_partition(one, other):
    """Equal up to the numbers: each cluster of the one is a cluster of the other."""
    pairs = np.unique(np.stack([one, other]), axis=1)
    return len(pairs.T) == len(np.unique(one)) == len(np.unique(other))


@pytest.mark.parametrize("seed", range(5))
def test_clusters_are_those_of_the_textbook_method(seed):
    rng = np.random.default_rng(seed)
    points, truth = boxes(rng, 5, 4000)
    slow = DBSCAN(eps=0.03, min_samples=60).fit(points).labels_
    fast = dbscan(points, np.ones(len(points)), 0.03, 60.0)
    assert adjusted_rand_score(truth, fast) >= 0.999
    np.testing.assert_array_equal(slow < 0, fast < 0)
    assert same_partition(slow, fast)


@settings(max_examples=60)
@given(
    seed=st.integers(0, 2**32 - 1),
    n_points=st.integers(1, 300),
    eps=st.floats(0.02, 0.6),
    core=st.integers(1, 12),
    flat=st.booleans(),
)
def test_on_random_points_cores_noise_and_their_clusters_are_exact(seed, n_points, eps, core, flat):
    points = np.random.default_rng(seed).uniform(-0.5, 0.5, (n_points, 3))
    # Points on a lattice: distances that equal eps, and points on the cells' faces.
    points = np.round(points, 1) if flat else points
    eps = max(round(eps, 1), 0.1) + 1e-12 if flat else eps
    slow = DBSCAN(eps=eps, min_samples=core).fit(points)
    fast = dbscan(points, np.ones(n_points), eps, float(core))
    np.testing.assert_array_equal(slow.labels_ < 0, fast < 0)
    cores = slow.core_sample_indices_
    if len(cores):
        assert same_partition(slow.labels_[cores], fast[cores])
    distance = np.linalg.norm(points[:, None] - points[cores], axis=-1)
    for i in np.setdiff1d(np.flatnonzero(fast >= 0), cores):
        nearest = distance[i] <= distance[i].min() + 1e-12
        assert distance[i].min() <= eps
        assert fast[i] in fast[cores][nearest]


@settings(max_examples=20)
@given(seed=st.integers(0, 2**32 - 1))
def test_clusters_do_not_depend_on_where_the_points_are_or_how_they_are_turned(seed):
    rng = np.random.default_rng(seed)
    # A gap between 0.9 and 1.1 eps: where cells that approximate would decide by chance.
    points, _ = boxes(rng, 3, 400, gap=rng.uniform(0.027, 0.033))
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    weights = np.ones(len(points))
    moved = points @ turn + rng.uniform(-10, 10, 3)
    assert same_partition(dbscan(points, weights, 0.03, 10.0), dbscan(moved, weights, 0.03, 10.0))


def test_weights_stand_for_points_that_many_times():
    rng = np.random.default_rng(0)
    points, _ = boxes(rng, 3, 1000)
    copies = rng.integers(1, 4, len(points))
    heavy = dbscan(points, copies.astype(float), 0.03, 40.0)
    repeated = dbscan(np.repeat(points, copies, axis=0), np.ones(copies.sum()), 0.03, 40.0)
    assert adjusted_rand_score(np.repeat(heavy, copies), repeated) >= 0.999


def test_area_as_weight_makes_clusters_the_same_at_any_density():
    rng = np.random.default_rng(0)
    for n_points in (500, 2000, 20_000):
        points, truth = boxes(rng, 4, n_points)
        fine = dbscan(points, np.full(len(points), 0.02 / n_points), 0.03, 5e-4)
        assert fine.max() + 1 == 4
        assert adjusted_rand_score(truth[truth >= 0], fine[truth >= 0]) >= 0.99


@settings(max_examples=20)
@given(seed=st.integers(0, 2**32 - 1))
def test_permuting_the_points_permutes_the_labels(seed):
    rng = np.random.default_rng(seed)
    points, _ = boxes(rng, 3, 300)
    order = rng.permutation(len(points))
    weights = np.ones(len(points))
    np.testing.assert_array_equal(
        dbscan(points, weights, 0.03, 10.0)[order], dbscan(points[order], weights, 0.03, 10.0)
    )


def test_thin_weight_is_noise_and_no_points_have_no_labels():
    points = np.random.default_rng(0).uniform(0, 0.02, (50, 3))
    assert (dbscan(points, np.full(50, 0.01), 0.03, 1.0) == -1).all()
    assert (dbscan(points, np.full(50, 0.1), 0.05, 1.0) == 0).all()
    assert dbscan(np.zeros((0, 3)), np.zeros(0), 0.03, 1.0).shape == (0,)


@pytest.mark.parametrize(("eps", "core"), [(0.0, 1.0), (0.03, 0.0), (-1.0, 1.0)])
def test_sizes_that_are_not_positive_are_refused(eps, core):
    with pytest.raises(ValueError, match="eps and core_weight must be > 0"):
        dbscan(np.zeros((3, 3)), np.ones(3), eps, core)


def test_points_that_are_not_finite_or_too_far_apart_are_refused():
    points = np.zeros((3, 3))
    points[1, 2] = np.nan
    with pytest.raises(ValueError, match="points must be finite"):
        dbscan(points, np.ones(3), 0.1, 1.0)
    with pytest.raises(ValueError, match=r"eps of 1e-06 is too small for points that spread over 1e\+03"):
        dbscan(np.diag([1e3, 1e3, 1e3]), np.ones(3), 1e-6, 1.0)
