from __future__ import annotations

import numpy as np
import pytest

from bask_data.core.log_ratio import MISTAKEN, log_ratio


def normal(mean: float, n: int, seed: int, sigma: float = 0.2) -> np.ndarray:
    return np.random.default_rng(seed).normal(mean, sigma, n)


def test_normal_distributions_give_the_slope_and_the_crossing_of_their_ratio() -> None:
    alpha, crossing = log_ratio(normal(0.6, 100_000, 0), normal(0.9, 100_000, 1), mistaken=0.0)
    assert alpha == pytest.approx(0.3 / 0.2**2, rel=0.02)
    assert crossing == pytest.approx(0.75, abs=0.005)


def test_a_sort_counts_the_same_however_many_samples_it_has() -> None:
    few, many = normal(0.6, 20_000, 0), normal(0.9, 200_000, 1)
    assert log_ratio(few, many, mistaken=0.0)[1] == pytest.approx(0.75, abs=0.01)


def test_weights_count_as_repeated_samples() -> None:
    true, rival = normal(0.6, 300, 0), normal(0.9, 200, 1)
    weight = np.random.default_rng(2).integers(1, 4, 300)
    repeated = log_ratio(np.repeat(true, weight), rival)
    assert log_ratio(true, rival, weight.astype(float)) == pytest.approx(repeated, rel=1e-4)


def test_distances_that_do_not_overlap_give_the_odds_of_a_mistake() -> None:
    alpha, crossing = log_ratio(np.full(50, 0.2), np.full(50, 1.2))
    assert crossing == pytest.approx(0.7, abs=1e-4)
    assert alpha * 0.5 == pytest.approx(np.log((1 - MISTAKEN) / MISTAKEN), rel=1e-3)


def test_alpha_has_bounds_within_which_the_crossing_fits_best() -> None:
    alpha, crossing = log_ratio(normal(0.9, 5000, 0), normal(0.6, 5000, 1), least=2.0)
    assert alpha == pytest.approx(2.0)
    assert crossing == pytest.approx(0.75, abs=0.02)
    assert log_ratio(np.full(9, 0.50), np.full(9, 0.51), most=64.0) == pytest.approx((64.0, 0.505), rel=1e-3)
    assert log_ratio(np.full(9, 0.5), np.full(9, 0.5), least=1.0) == pytest.approx((1.0, 0.5))
