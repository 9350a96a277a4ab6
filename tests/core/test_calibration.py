from __future__ import annotations

import numpy as np
import pytest

from bask_data.core.calibration import (
    LEAST_SIGHTINGS,
    SHARP_ALPHAS,
    Calibration,
    Evidence,
    calibrated,
)


def evidence(true: dict[int, np.ndarray], rival: dict[int, np.ndarray], best: int = 2) -> Evidence:
    """Samples by keypoint; the `best` of the temperatures takes the mean pixel to the keypoint."""
    n = sum(map(len, true.values()))
    off = np.ones((n, len(SHARP_ALPHAS)))
    off[:, best] = 0.1
    return Evidence(
        np.concatenate(list(true.values())),
        np.repeat(list(true), list(map(len, true.values()))),
        np.concatenate(list(rival.values())),
        np.repeat(list(rival), list(map(len, rival.values()))),
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
    assert repeated.crossing[2] == pytest.approx(once.crossing[2], rel=1e-4)


def test_a_keypoint_with_many_frames_has_its_own_values_and_one_without_those_of_the_average() -> None:
    far, near = (normal(0.6, 4000, 0), normal(0.9, 4000, 1)), (normal(0.2, 4000, 2), normal(0.5, 4000, 3))
    found = calibrated(evidence({0: far[0], 1: near[0]}, {0: far[1], 1: near[1]}), 3)
    assert found is not None
    assert found.crossing[:2] == pytest.approx([0.75, 0.35], abs=0.02)
    assert found.crossing[0] > found.crossing[2] > found.crossing[1]
    assert found.tau == pytest.approx(np.exp(-found.alpha * found.crossing))


def test_few_frames_decide_little() -> None:
    many, few = (normal(0.6, 4000, 0), normal(0.9, 4000, 1)), (normal(0.2, 4, 2), normal(0.5, 50, 3))
    found = calibrated(evidence({0: many[0], 1: few[0]}, {0: many[1], 1: few[1]}), 3)
    assert found is not None
    assert abs(found.crossing[1] - found.crossing[2]) < 0.3 * abs(found.crossing[2] - 0.35)


def test_single_frames_have_the_temperature_whose_mean_pixel_is_nearest() -> None:
    found = calibrated(evidence({0: normal(0.6, 40, 0)}, {0: normal(0.9, 40, 1)}, best=3), 2)
    assert found is not None
    assert found.sharp_alpha == pytest.approx([SHARP_ALPHAS[3]] * 2)


def test_too_few_frames_or_no_rival_calibrate_nothing() -> None:
    few, enough = normal(0.6, LEAST_SIGHTINGS - 1, 0), normal(0.6, LEAST_SIGHTINGS, 0)
    assert calibrated(evidence({0: few}, {0: normal(0.9, 40, 1)}), 1) is None
    assert calibrated(evidence({0: enough}, {0: np.empty(0)}), 1) is None
    assert calibrated(evidence({0: np.empty(0)}, {0: np.empty(0)}), 1) is None
    assert isinstance(calibrated(evidence({0: enough}, {0: normal(0.9, 40, 1)}), 1), Calibration)
