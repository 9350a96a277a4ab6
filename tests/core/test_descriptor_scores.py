from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bask_data.core.descriptor_scores import (
    LIMITS,
    N_CURVE,
    Records,
    area_above,
    cumulative,
    figures,
    filling,
    map_scores,
    reliability,
)

SEEDS = st.integers(0, 2**32 - 1)


def records(n: int, seed: int = 0) -> Records:
    rng = np.random.default_rng(seed)
    error = rng.exponential(10, n)
    return Records(
        error_px=error,
        error_share=error / 100,
        error_3d=np.where(rng.random(n) < 0.3, np.nan, rng.exponential(0.05, n)),
        closer_share=rng.random(n),
        false_positive_px=rng.exponential(20, n),
        false_positive_share=rng.exponential(0.2, n),
        confidence=rng.random((n, 3)),
        is_near=error <= 4,
    )


# Maps -----------------------------------------------------------------------------------------------------------------


@given(SEEDS, st.floats(0, 8), st.floats(0.3, 30))
def test_scores_of_maps_are_those_of_a_loop_over_pixels(seed, alpha, radius):
    rng = np.random.default_rng(seed)
    n, height, width = rng.integers(1, [4, 9, 9])
    size = tuple(int(one) for one in rng.integers(1, 40, 2))
    z = rng.random((n, height, width)).astype(np.float32)
    at_truth, truth = rng.random(n), rng.uniform(-1, 40, (n, 2))
    found = map_scores(z, at_truth, truth, size, (alpha, 2.0), radius)
    for i in range(n):
        places, heats, closer = {}, {}, []
        for row in range(height):
            for column in range(width):
                # Edges of map and image agree; pixel centres are integers in both.
                place = ((column + 0.5) / width * size[1] - 0.5, (row + 0.5) / height * size[0] - 0.5)
                places[row, column] = np.array(place)
                heats[row, column] = np.exp(-alpha * float(z[i, row, column]))
                if z[i, row, column] < at_truth[i]:
                    closer.append(np.hypot(*(places[row, column] - truth[i])))
        best = places[min(places, key=lambda at: float(z[i][at]))]
        total = sum(heats.values())
        np.testing.assert_allclose(found.best[i], best, atol=1e-9)
        assert found.error_px[i] == pytest.approx(np.hypot(*(best - truth[i])))
        assert found.closer_share[i] == pytest.approx(len(closer) / z[i].size)
        assert found.false_positive_px[i] == pytest.approx(np.mean(closer) if closer else 0.0)
        close = [at for at in heats if np.hypot(*(places[at] - best)) <= radius]
        assert found.confidence[i, 0] == pytest.approx(sum(heats[at] for at in close) / total, rel=1e-5)
        others = {at: np.exp(-2.0 * float(z[i][at])) for at in heats}
        near = sum(others[at] for at in close) / sum(others.values())
        assert found.confidence[i, 1] == pytest.approx(near, rel=1e-5)
        expected = sum(heats[at] * places[at] for at in heats) / total
        np.testing.assert_allclose(found.expected[i], expected, rtol=1e-5, atol=1e-4)


def cone(centre: tuple[float, float], height: int, width: int) -> np.ndarray:
    """Distance maps that grow with the way from a position, a thousandth a pixel."""
    v, u = np.mgrid[:height, :width]
    return (1e-3 * np.hypot(u - centre[0], v - centre[1])).astype(np.float32)[None]


def test_a_map_that_is_right_leaves_no_pixel_closer_and_is_sure_when_it_is_sharp():
    z, truth = cone((40.0, 30.0), 80, 100), np.array([[40.0, 30.0]])
    found = map_scores(z, np.zeros(1), truth, (80, 100), (1e4,), 3.0)
    assert found.error_px[0] == 0
    assert (found.closer_share[0], found.false_positive_px[0]) == (0, 0)
    assert found.confidence[0, 0] > 0.999
    np.testing.assert_allclose(found.expected, truth, atol=1e-3)
    # A flat heat map says no more than how large the circle is.
    blunt = map_scores(z, np.zeros(1), truth, (80, 100), (0.0,), 20.0)
    assert blunt.confidence[0, 0] == pytest.approx(np.pi * 20**2 / 8000, rel=0.02)


def test_a_map_that_peaks_elsewhere_counts_the_disc_around_the_wrong_place():
    way = 15.0
    z, truth = cone((50.0, 40.0), 80, 100), np.array([[50.0 + way, 40.0]])
    found = map_scores(z, np.array([1e-3 * way]), truth, (80, 100), (4.0,), 3.0)
    assert found.error_px[0] == way
    assert found.closer_share[0] == pytest.approx(np.pi * way**2 / 8000, rel=0.03)
    # The mean distance of a disc's points to a point on its rim is 32 / (9 pi) of its radius.
    assert found.false_positive_px[0] == pytest.approx(32 / (9 * np.pi) * way, rel=0.03)


# Figures --------------------------------------------------------------------------------------------------------------


def test_figures_are_counted_by_hand():
    zeros = np.zeros(4)
    told = figures(
        Records(
            error_px=np.array([1.0, 2.0, 9.0, 50.0]),
            error_share=np.array([0.01, 0.02, 0.09, 0.5]),
            error_3d=np.array([0.001, np.nan, 0.003, 0.5]),
            closer_share=np.array([0.0, 0.1, 0.2, 0.9]),
            false_positive_px=np.array([0.0, 4.0, 8.0, 12.0]),
            false_positive_share=np.array([0.0, 0.04, 0.08, 0.12]),
            confidence=zeros[:, None],
            is_near=zeros > 0,
        )
    )
    assert (told["n"], told["n_3d"], told["median_px"]) == (4, 3, 5.5)
    assert [told[f"pck_{percent}"] for percent in (1, 2, 4, 8)] == [0.25, 0.5, 0.5, 0.5]
    assert told["median_3d_m"] == 0.003
    assert (told["closer_mean"], told["closer_median"]) == (pytest.approx(0.3), pytest.approx(0.15))
    assert (told["false_positive_px"], told["false_positive_share"]) == (6.0, pytest.approx(0.06))
    assert told["area_error_share"] == pytest.approx(0.62 / 4)
    assert told["area_error_3d"] == pytest.approx((0.01 + 0.03 + 1.0) / 3)


def test_figures_of_nothing_are_unknown():
    told = figures(Records.joined([]))
    assert (told.pop("n"), told.pop("n_3d")) == (0, 0)
    assert set(told.values()) == {None}


@given(SEEDS)
def test_parts_and_choices_together_are_the_whole(seed):
    whole = records(20, seed)
    which = np.random.default_rng(seed).random(20) < 0.5
    joined = Records.joined([whole.chosen(which), whole.chosen(~which)])
    assert len(joined) == 20
    for name in LIMITS:
        np.testing.assert_array_equal(np.sort(getattr(joined, name)), np.sort(getattr(whole, name)))
    assert joined.is_near.dtype == bool


@given(SEEDS, st.floats(0.05, 2))
def test_a_cumulative_curve_counts_and_the_area_above_it_is_its_integral(seed, limit):
    values = np.random.default_rng(seed).exponential(0.3, 200)
    values[::7] = np.nan
    thresholds, share = cumulative(values, limit)
    known = values[~np.isnan(values)]
    assert len(thresholds) == N_CURVE and thresholds[0] == 0 and thresholds[-1] == pytest.approx(limit)
    assert thresholds[10] == pytest.approx(limit / 100)
    for threshold, one in zip(thresholds, share, strict=True):
        assert one == sum(value <= threshold for value in known) / len(known)
    fine = np.linspace(0, limit, 20001)
    above = 1 - np.searchsorted(np.sort(known), fine, side="right") / len(known)
    assert area_above(values, limit) == pytest.approx(np.trapezoid(above, fine) / limit, abs=1e-3)


def test_curves_of_nothing_are_unknown():
    assert np.isnan(cumulative(np.array([np.nan]), 1.0)[1]).all()
    assert area_above(np.array([np.nan]), 1.0) is None


# Calibration ----------------------------------------------------------------------------------------------------------


@given(SEEDS)
def test_reliability_is_that_of_sorting_into_bins(seed):
    rng = np.random.default_rng(seed)
    confidence, near = np.append(rng.random(30), 1.0), rng.random(31) < 0.5
    found, error = reliability(confidence, near, 5), 0.0
    for i in range(5):
        mine = [k for k in range(31) if min(int(confidence[k] * 5), 4) == i]
        assert found.n[i] == len(mine)
        if mine:
            sure, right = np.mean([confidence[k] for k in mine]), np.mean([near[k] for k in mine])
            assert (found.confidence[i], found.accuracy[i]) == (pytest.approx(sure), pytest.approx(right))
            error += len(mine) / 31 * abs(sure - right)
    assert found.error == pytest.approx(error)


def test_true_promises_have_no_calibration_error_and_vain_ones_have_it_all():
    rng = np.random.default_rng(0)
    confidence = rng.random(200_000)
    assert reliability(confidence, rng.random(200_000) < confidence).error < 0.01
    assert reliability(np.ones(10), np.zeros(10, bool)).error == 1.0
    assert reliability(np.full(10, 0.75), np.arange(10) < 5).error == 0.25
    assert np.isnan(reliability(np.zeros(0), np.zeros(0, bool)).error)


# Choosing -------------------------------------------------------------------------------------------------------------


def test_the_emptiest_column_is_filled_next():
    counts = np.array([[5, 0, 0]] * 20 + [[0, 1, 0]] * 6 + [[0, 0, 2]] * 3)
    chosen = filling(counts, [0, 1], 12, np.random.default_rng(0))
    assert chosen[:2] == [0, 1]
    assert len(chosen) == len(set(chosen)) == 12
    # Two rows of the first column outweigh all that there is of the others.
    assert counts[chosen].sum(axis=0).tolist() == [15, 6, 6]


def test_filling_ends_with_the_rows_that_add_something():
    counts = np.array([[1, 0], [0, 0], [1, 0]])
    assert sorted(filling(counts, [], 9, np.random.default_rng(0))) == [0, 2]


@given(SEEDS)
def test_filling_gives_the_same_for_the_same_seed_and_is_evener_than_chance(seed):
    rng = np.random.default_rng(seed)
    counts = rng.poisson([6.0, 2.0, 0.7], (80, 3))
    one, same = (filling(counts, [], 30, np.random.default_rng(seed)) for _ in range(2))
    assert one == same and len(set(one)) == 30
    assert counts[one].sum(axis=0).min() >= counts[:30].sum(axis=0).min()
