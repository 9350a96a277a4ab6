"""Certainty of tracks made by hand, whose errors are known."""

from __future__ import annotations

import numpy as np
import pytest

from bask_data.core.keypoint_scores import phases, sighting
from bask_data.evaluation.certainty import OF_CERTAINTY, certainty_figures, certainty_lines
from bask_data.evaluation.study_tracks import Tracked

T, K, SIGMA = 400, 5, 0.01
NAME = "main: particle"


def tracked(claimed_sigma: float, name: str = "demo", seed: int = 0, hidden_sigma: float = SIGMA) -> Tracked:
    """Errors of one centimetre along each axis, and another sigma while the only camera does not show the points, which
    is in the second half of the frames."""
    rng = np.random.default_rng(seed)
    places, inside = rng.normal(size=(T, K, 3)), np.ones((1, T, K), dtype=bool)
    hidden = inside & (np.arange(T) >= T // 2)[None, :, None]
    errors = np.where(hidden[0][..., None], hidden_sigma, SIGMA) * rng.normal(size=places.shape)
    track = Tracked(
        name,
        ["wrist"],
        np.arange(T),
        places,
        sighting(inside, hidden, places),
        np.zeros((1, T, K, 2)),
        inside & ~hidden,
    )
    track.mean[NAME] = places + errors
    track.covariance[NAME] = np.broadcast_to(claimed_sigma**2 * np.eye(3), (T, K, 3, 3)).copy()
    track.observed[NAME] = np.zeros((T, 1, K), dtype=bool)
    return track


def figures(*tracks: Tracked) -> dict:
    return certainty_figures(NAME, tracks, [phases(track.places, track.seen) for track in tracks])


def test_true_sigmas_are_calibrated_and_too_small_ones_are_not() -> None:
    true, small = (figures(tracked(sigma)) for sigma in (SIGMA, SIGMA / 2))
    np.testing.assert_allclose(true["coverage"]["all"]["within_sigmas"], [0.199, 0.739, 0.971], atol=0.03)
    assert true["coverage"]["all"]["calibration_error"] < 0.02
    assert small["coverage"]["all"]["calibration_error"] > 0.3
    assert true["coverage"]["all"]["n"] == T * K


def test_each_visibility_has_its_own_coverage() -> None:
    found = figures(tracked(SIGMA, hidden_sigma=3 * SIGMA))["coverage"]
    assert found["visible"]["calibration_error"] < 0.03 < 0.3 < found["occluded"]["calibration_error"]
    assert [found[phase]["n"] for phase in OF_CERTAINTY] == [T * K // 2, T * K // 2, 0, 0]
    assert found["out of view"]["calibration_error"] is None
    assert found["out of view"]["measured"] == [None] * 19


def test_frames_without_an_estimate_are_unknown_and_not_localised() -> None:
    track = tracked(SIGMA)
    track.mean[NAME][:100] = np.nan
    track.places[100:110] = np.nan
    found = figures(track)
    assert (found["coverage"]["all"]["n"], found["coverage"]["all"]["n_unknown"]) == ((T - 110) * K, 100 * K)
    assert found["localised"]["n"] == (T - 10) * K, "where ground truth is unknown, nothing is compared"
    assert found["localised"]["precision"] == 1.0
    assert found["localised"]["recall"] == pytest.approx((T - 110) / (T - 10))


def test_a_position_before_any_camera_shows_the_keypoint_is_claimed_too_early() -> None:
    track = tracked(SIGMA)
    track.seen.visible[:100] = False
    assert figures(track)["localised"]["precision"] == pytest.approx(1 - 100 / T)


def test_observed_is_compared_with_the_visibility_in_each_camera() -> None:
    first, second = tracked(SIGMA), tracked(SIGMA, "other", seed=1)
    first.observed[NAME][: T // 4, 0] = True
    second.observed[NAME][:, 0] = True
    second.cameras[:] = ["overhead"]
    observed = figures(first, second)["observed"]
    assert [observed["wrist"][what] for what in ("precision", "recall")] == [1.0, 0.5]
    assert [observed["overhead"][what] for what in ("precision", "recall")] == [0.5, 1.0]


def test_claims_that_were_never_made_have_no_precision() -> None:
    assert figures(tracked(SIGMA))["observed"]["wrist"]["precision"] is None


def test_the_table_has_a_row_for_each_method_and_for_a_calibrated_belief() -> None:
    found = figures(tracked(SIGMA))
    lines = list(certainty_lines({NAME: {"certainty": found}}))
    row = next(line for line in lines if NAME in line)
    all_ = found["coverage"]["all"]
    assert row.split()[2:6] == [f"{100 * share:.1f}" for share in (*all_["within_sigmas"], all_["calibration_error"])]
    assert "- / 0.0" in row
    assert any("a calibrated belief" in line and "19.9" in line for line in lines)
