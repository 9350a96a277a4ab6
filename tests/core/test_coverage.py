"""Coverage of covariances, and claims of visibility."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2

from bask_data.core.coverage import LEVELS, chi_square_share, claims, coverage, mahalanobis_squared


def _errors(n: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Samples of Gaussians, each with a covariance of its own."""
    rng = np.random.default_rng(seed)
    roots = rng.normal(size=(n, 3, 3)) * rng.uniform(0.001, 0.1, (n, 1, 1))
    return np.einsum("nij,nj->ni", roots, rng.normal(size=(n, 3))), roots @ roots.swapaxes(1, 2)


def test_true_covariances_hold_the_shares_of_a_gaussian_in_3d() -> None:
    found = coverage(*_errors(100_000))
    assert found.n == 100_000
    np.testing.assert_allclose(found.within, [0.1987, 0.7385, 0.9707], atol=0.005)
    np.testing.assert_allclose(found.measured, LEVELS, atol=0.006)
    assert found.error < 0.003


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_a_wrong_scale_of_sigma_gives_the_known_curve(factor: float) -> None:
    offset, covariance = _errors(100_000, seed=1)
    found = coverage(offset, covariance * factor**2)
    expected = chi2.cdf(factor**2 * chi2.ppf(LEVELS, 3), 3)
    np.testing.assert_allclose(found.measured, expected, atol=0.006)
    assert found.error == pytest.approx(np.abs(expected - LEVELS).mean(), abs=0.003)
    assert (found.measured < LEVELS).all() == (factor < 1), "a small sigma claims too much"


def test_share_of_a_gaussian_is_that_of_chi_square_with_three_degrees_of_freedom() -> None:
    squared = np.linspace(0, 20, 41)
    np.testing.assert_allclose(chi_square_share(squared), chi2.cdf(squared, 3), atol=1e-12)


def test_distance_is_that_of_the_inverse() -> None:
    offset, covariance = _errors(50, seed=2)
    expected = np.einsum("ni,nij,nj->n", offset, np.linalg.inv(covariance), offset)
    np.testing.assert_allclose(mahalanobis_squared(offset, covariance), expected, rtol=1e-6)


def test_a_covariance_of_zero_claims_a_micrometre() -> None:
    offset = np.array([[0.0, 0.0, 0.0], [1e-6, 0.0, 0.0], [0.01, 0.0, 0.0]])
    np.testing.assert_allclose(mahalanobis_squared(offset, np.zeros((3, 3, 3))), [0.0, 1.0, 1e8])
    found = coverage(offset, np.zeros((3, 3, 3)))
    assert (found.n, found.n_invalid) == (3, 0)
    np.testing.assert_allclose(found.within, [2 / 3] * 3)


def test_an_indefinite_covariance_is_left_out_and_counted_but_one_that_was_rounded_is_not() -> None:
    rounded, indefinite = np.diag([1e-4, 1e-4, -1e-10]), np.diag([1e-4, 1e-4, -1e-5])
    found = coverage(np.zeros((2, 3)), np.stack([rounded, indefinite]))
    assert (found.n, found.n_invalid, found.n_unknown) == (1, 1, 0)
    assert np.isinf(mahalanobis_squared(np.zeros((1, 3)), -np.eye(3)[None])).all()


def test_unknown_errors_and_covariances_are_left_out_and_counted() -> None:
    offset, covariance = _errors(10)
    offset[2, 1] = np.nan
    covariance[3, 0, 0] = np.inf
    found, kept = coverage(offset, covariance), np.delete(np.arange(10), [2, 3])
    assert (found.n, found.n_unknown) == (8, 2)
    np.testing.assert_array_equal(found.measured, coverage(offset[kept], covariance[kept]).measured)


def test_without_anything_known_there_is_no_share() -> None:
    found = coverage(np.full((4, 3), np.nan), np.zeros((4, 3, 3)))
    assert (found.n, found.n_unknown) == (0, 4)
    assert np.isnan([found.error, *found.within, *found.measured]).all()


def test_precision_and_recall_of_a_claim() -> None:
    claimed = np.array([[True, True, True], [False, False, True]])
    is_true = np.array([[True, True, False], [True, False, True]])
    found = claims(claimed, is_true, np.array([[True, True, True], [True, True, False]]))
    assert (found.n, found.n_claimed, found.n_true) == (5, 3, 3)
    assert found.precision == pytest.approx(2 / 3)
    assert found.recall == pytest.approx(2 / 3)
    assert claims(claimed, is_true).recall == pytest.approx(3 / 4)


def test_nothing_claimed_has_no_precision_and_nothing_true_no_recall() -> None:
    nothing = np.zeros(3, dtype=bool)
    found = claims(nothing, nothing)
    assert np.isnan([found.precision, found.recall]).all()
    assert claims(nothing, ~nothing).recall == 0
