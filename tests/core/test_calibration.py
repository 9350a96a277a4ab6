from __future__ import annotations

import numpy as np
import pytest

from bask_data.core.calibration import (
    LEAST_ALPHA,
    LEAST_SIGHTINGS,
    MOST_TAU_RATIO,
    TEMPERATURES,
    UNTOLD_TAU,
    Calibration,
    Evidence,
    calibrated,
    joined,
)


def evidence(true: dict[int, np.ndarray], rival: dict[int, np.ndarray], level: float = 1.0, best: int = 2) -> Evidence:
    """Samples by keypoint, frames of one level; the `best` of the temperatures takes the mean pixel to the keypoint."""
    n, m = sum(map(len, true.values())), sum(map(len, rival.values()))
    off = np.ones((n, len(TEMPERATURES)))
    off[:, best] = 0.1
    return Evidence(
        np.concatenate(list(true.values())),
        np.repeat(list(true), list(map(len, true.values()))),
        np.full((n, len(TEMPERATURES)), level),
        np.concatenate(list(rival.values())),
        np.repeat(list(rival), list(map(len, rival.values()))),
        np.full((m, len(TEMPERATURES)), level),
        off,
    )


def normal(mean: float, n: int, seed: int, sigma: float = 0.2) -> np.ndarray:
    return np.random.default_rng(seed).normal(mean, sigma, n)


def test_an_error_seen_ten_times_is_no_more_evidence_than_once() -> None:
    true, rival = {0: normal(0.6, 40, 0), 1: normal(0.5, 40, 1)}, {0: normal(0.9, 60, 2), 1: normal(0.8, 60, 3)}
    repeated = calibrated(evidence(*({i: np.tile(z, 10) for i, z in one.items()} for one in (true, rival))), 3)
    once = calibrated(evidence(true, rival), 3)
    assert once is not None
    assert repeated is not None
    assert repeated.alpha[2] == pytest.approx(once.alpha[2], rel=1e-4)
    assert repeated.tau_ratio[2] == pytest.approx(once.tau_ratio[2], rel=1e-4)


def crossing(found: Calibration) -> np.ndarray:
    """Distance above the level at which a match is as likely at a rival."""
    return -np.log(found.tau_ratio) / found.alpha


def test_tau_is_where_keypoint_and_rivals_are_equally_likely() -> None:
    found = calibrated(evidence({0: normal(0.9, 4000, 0)}, {0: normal(1.2, 4000, 1)}, level=1.0), 1)
    assert found is not None
    assert found.alpha == pytest.approx(0.3 / 0.2**2, rel=0.1)
    assert crossing(found) == pytest.approx([0.05], abs=0.02)


def test_frames_whose_distances_all_rise_say_the_same() -> None:
    true, rival = {0: normal(0.9, 400, 0)}, {0: normal(1.2, 400, 1)}
    near = evidence(true, rival)
    far = evidence({0: true[0] + 5}, {0: rival[0] + 5}, level=6.0)
    found, expected = calibrated(joined([near, far]), 1), calibrated(joined([near, near]), 1)
    assert found is not None
    assert expected is not None
    np.testing.assert_allclose(found.alpha, expected.alpha, rtol=1e-4)
    np.testing.assert_allclose(found.tau_ratio, expected.tau_ratio, rtol=1e-4)


def test_a_keypoint_with_many_frames_has_its_own_values_and_one_without_those_of_the_average() -> None:
    far, near = (normal(1.2, 4000, 0), normal(1.5, 4000, 1)), (normal(0.9, 4000, 2), normal(1.2, 4000, 3))
    measured = evidence({0: far[0], 1: near[0]}, {0: far[1], 1: near[1]})
    found = calibrated(measured, 3)
    assert found is not None
    assert crossing(found)[:2] == pytest.approx([0.35, 0.05], abs=0.02)
    assert crossing(found)[0] > crossing(found)[2] > crossing(found)[1]


def test_few_frames_decide_little() -> None:
    many, few = (normal(1.2, 4000, 0), normal(1.5, 4000, 1)), (normal(0.9, 4, 2), normal(1.2, 50, 3))
    found = calibrated(evidence({0: many[0], 1: few[0]}, {0: many[1], 1: few[1]}), 3)
    assert found is not None
    assert abs(crossing(found)[1] - crossing(found)[2]) < 0.3 * abs(crossing(found)[2] - 0.05)


def test_where_rivals_match_as_well_tau_is_below_the_usual_match() -> None:
    found = calibrated(evidence({0: normal(0.87, 401, 0)}, {0: normal(0.86, 400, 1)}, level=0.95), 1)
    assert found is not None
    assert found.alpha == pytest.approx([LEAST_ALPHA])
    usual = np.exp(-LEAST_ALPHA * (np.median(normal(0.87, 401, 0)) - 0.95))
    assert found.tau_ratio == pytest.approx([UNTOLD_TAU * usual])


def test_a_measurement_lowers_tau_only_and_does_not_flatten_the_heat_maps() -> None:
    found = calibrated(evidence({0: normal(0.5, 400, 0)}, {0: normal(0.4, 400, 1)}, level=2.0), 1)
    assert found is not None
    assert found.alpha == pytest.approx([LEAST_ALPHA])
    assert found.tau_ratio == pytest.approx([MOST_TAU_RATIO])


@pytest.mark.parametrize("z", [0.0, 1.0, 30.0])
def test_a_ratio_is_positive_however_far_from_the_level_a_keypoint_matches(z: float) -> None:
    found = calibrated(evidence({0: normal(z, 40, 0, 1e-3)}, {0: normal(z + 0.01, 40, 1, 1e-3)}, level=15.0), 1)
    assert found is not None
    assert (found.tau_ratio.astype(np.float32) > 0).all()
    assert (found.tau_ratio <= MOST_TAU_RATIO).all()


def test_single_frames_have_the_temperature_whose_mean_pixel_is_nearest() -> None:
    found = calibrated(evidence({0: normal(0.6, 40, 0)}, {0: normal(0.9, 40, 1)}, best=3), 2)
    assert found is not None
    assert found.sharp_alpha == pytest.approx([TEMPERATURES[3]] * 2)


def test_too_few_frames_or_no_rival_calibrate_nothing() -> None:
    few, enough = normal(0.6, LEAST_SIGHTINGS - 1, 0), normal(0.6, LEAST_SIGHTINGS, 0)
    assert calibrated(evidence({0: few}, {0: normal(0.9, 40, 1)}), 1) is None
    assert calibrated(evidence({0: enough}, {0: np.empty(0)}), 1) is None
    assert calibrated(evidence({0: np.empty(0)}, {0: np.empty(0)}), 1) is None
    assert isinstance(calibrated(evidence({0: enough}, {0: normal(0.9, 40, 1)}), 1), Calibration)
