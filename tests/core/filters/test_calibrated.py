from __future__ import annotations

import numpy as np
import pytest

from bask_data.core.calibration import Calibration
from bask_data.core.filters.calibrated import calibrated_settings, likelihood_text, range_text
from bask_data.core.filters.heatmap import unseen_likelihood
from bask_data.core.filters.particle.settings import IF_CALIBRATED, ParticleSettings
from bask_data.core.filters.table import FILTERS, settings_named

MEASURED = Calibration(alpha=np.array([2.0, 4.0]), tau_ratio=np.array([0.5, 2.0]), sharp_alpha=np.array([32.0, 32.0]))


def test_filters_take_alpha_and_tau_as_measured() -> None:
    particle = calibrated_settings("particle", MEASURED)
    assert particle == ParticleSettings(alpha=(2.0, 4.0), tau_ratio=(0.5, 2.0), **IF_CALIBRATED)
    discrete = calibrated_settings("discrete", MEASURED)
    assert discrete == settings_named("discrete", alpha=(2.0, 4.0), tau_ratio=(0.5, 2.0))


def test_single_frames_have_the_temperature_of_single_frames() -> None:
    assert calibrated_settings("expectation", MEASURED) == settings_named("expectation", alpha=(32.0, 32.0))


@pytest.mark.parametrize("name", list(FILTERS))
def test_the_presets_of_the_sources_take_nothing_that_was_measured(name: str) -> None:
    for preset in ("paper", "code"):
        assert calibrated_settings(name, MEASURED, preset) == settings_named(name, preset)
    assert calibrated_settings(name, None) == settings_named(name)


def test_values_that_are_given_take_precedence() -> None:
    assert calibrated_settings("expectation", MEASURED, alpha=5.0).alpha == 5.0  # type: ignore[attr-defined]
    given = calibrated_settings("particle", MEASURED, tau=0.1, walk=0.3, found=3.0, residual_sigma=0.5)
    measured = {"alpha": (2.0, 4.0), "tau_ratio": (0.5, 2.0)}
    assert given == ParticleSettings(**measured, tau=0.1, walk=0.3, found=3.0, residual_sigma=0.5)


def test_with_another_alpha_tau_is_the_likelihood_at_the_same_distance() -> None:
    given = calibrated_settings("particle", MEASURED, alpha=4.0, tau=None)
    assert isinstance(given, ParticleSettings)
    assert given.alpha == 4.0
    assert given.tau_ratio == pytest.approx((0.25, 2.0))


@pytest.mark.parametrize("alpha", [1e-3, 1e5])
def test_an_extreme_alpha_leaves_tau_a_number(alpha: float) -> None:
    given = calibrated_settings("particle", MEASURED, alpha=alpha)
    distance = np.linspace(0.1, 1.0, 32, dtype=np.float32).reshape(2, 4, 4)
    assert isinstance(given, ParticleSettings)
    tau = unseen_likelihood(distance, given.alpha, given.tau, given.tau_ratio)
    assert ((tau > 0) & (tau < 1)).all()


def test_the_text_says_what_is_used_and_whether_it_was_measured() -> None:
    text = likelihood_text(calibrated_settings("particle", MEASURED))
    assert text == "alpha 2 to 4 (measured), tau 0.5 to 2 (measured) times the likelihood of an image's average pixel"
    assert likelihood_text(calibrated_settings("expectation", MEASURED)) == "alpha 32 (measured)"
    assert likelihood_text(settings_named("particle", tau=0.1)) == "alpha 2, tau 0.1"


def test_numbers_that_look_the_same_are_written_once() -> None:
    assert range_text(np.array([2.0, 2.004])) == "2"
    assert range_text((6.0, 5.0)) == "5 to 6"
