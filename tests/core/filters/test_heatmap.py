from __future__ import annotations

import numpy as np

from bask_data.core.filters.heatmap import softmax_map, unseen_likelihood


def test_heat_maps_are_the_softmax_and_their_evidence_is_the_mean_likelihood() -> None:
    distance = np.random.default_rng(0).uniform(0, 2, (3, 5, 7)).astype(np.float32)
    heat, log_evidence = softmax_map(distance, 4.0)
    likelihood = np.exp(-4.0 * distance.astype(np.float64))
    np.testing.assert_allclose(heat, likelihood / likelihood.sum((1, 2), keepdims=True), rtol=1e-5)
    np.testing.assert_allclose(log_evidence, np.log(likelihood.mean((1, 2))), rtol=1e-5)


def test_heat_maps_of_distances_beyond_the_range_of_exp_still_sum_to_one() -> None:
    heat, log_evidence = softmax_map(np.full((1, 4, 4), 1e4, dtype=np.float32), 4.0)
    np.testing.assert_allclose(heat.sum(), 1.0)
    np.testing.assert_allclose(log_evidence, -4e4)


def test_the_likelihood_of_being_unseen_follows_the_background_whatever_its_distances_are() -> None:
    rng = np.random.default_rng(0)
    for background in (0.4, 0.8, 2.0):
        distance = (background + 0.05 * rng.standard_normal((1, 60, 80))).astype(np.float32)
        distance[0, 30:34, 40:44] = 0.1
        tau = unseen_likelihood(distance, 4.0, None, 2.0)[0]
        assert np.exp(-4 * background) < tau < np.exp(-4 * 0.1)
        assert unseen_likelihood(distance, 4.0, 0.07, 2.0)[0] == 0.07


def test_an_image_full_of_matches_does_not_say_the_keypoint_is_unseen() -> None:
    tau = unseen_likelihood(np.full((1, 8, 8), 0.1, dtype=np.float32), 4.0, None, 2.0)
    assert tau < 0.5 * np.exp(-0.4)
