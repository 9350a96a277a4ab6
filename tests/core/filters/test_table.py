from __future__ import annotations

import inspect
import math
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from bask_data.core.filters.discrete import DiscreteSettings
from bask_data.core.filters.expectation import ExpectationSettings
from bask_data.core.filters.observation import Observation
from bask_data.core.filters.particle.settings import ParticleSettings
from bask_data.core.filters.step import step
from bask_data.core.filters.table import FilterSettings, alpha_of_one_frame, filter_named, settings_named

K = np.array([[60.0, 0, 19.5], [0, 60.0, 14.5], [0, 0, 1]])
PLACES = np.array([[0.05, 0.02, 1.0], [-0.1, -0.05, 1.0]])
ALL = [ExpectationSettings(alpha=30.0), DiscreteSettings(), ParticleSettings(n_particles=1000)]


def wall(x: float = 0.0) -> Observation:
    """A wall one metre away, seen from x metres beside the origin; distances rise with the distance to the two
    places."""
    v, u = np.mgrid[:30, :40]
    points = np.stack([(u - 19.5) / 60 + x, (v - 14.5) / 60, np.ones((30, 40))], -1)
    z = 1 - np.exp(-((points - PLACES[:, None, None]) ** 2).sum(-1) / (2 * 0.05**2))
    world_from_camera = np.eye(4)
    world_from_camera[0, 3] = x
    return Observation(z.astype(np.float32), np.ones((30, 40), dtype=np.float32), K, world_from_camera)


@pytest.mark.parametrize("settings", ALL)
def test_a_camera_without_a_frame_leaves_everything_to_the_other(settings: FilterSettings) -> None:
    rng, alone = np.random.default_rng(0), np.random.default_rng(0)
    belief = single = None
    for _ in range(6):
        belief, estimate = step(belief, [None, wall(0.1)], None, rng, settings)
        single, expected = step(single, [wall(0.1)], None, alone, settings)
    for name in ("mean", "covariance", "mode", "n_eff", "log_evidence"):
        np.testing.assert_array_equal(getattr(estimate, name), getattr(expected, name))
    assert np.isnan(estimate.pixel[0]).all()
    assert not estimate.observed[0].any()
    np.testing.assert_array_equal(estimate.pixel[1], expected.pixel[0])
    np.testing.assert_array_equal(estimate.observed[1], expected.observed[0])
    assert estimate.observed[1].all()


@pytest.mark.parametrize("settings", ALL)
def test_cameras_may_come_and_go(settings: FilterSettings) -> None:
    rng, belief = np.random.default_rng(0), None
    both = [wall(-0.1), wall(0.1)]
    for given in ([1, 0], [0, 0], [0, 1], [1, 1], [0, 0], [1, 1], [1, 0], [1, 1]):
        seen = [one if there else None for one, there in zip(both, given, strict=True)]
        belief, estimate = step(belief, seen, None, rng, settings)
        np.testing.assert_array_equal(np.isnan(estimate.pixel).any(axis=(1, 2)), np.array(given) == 0)
        assert not estimate.observed[np.array(given) == 0].any()
        assert np.isfinite(estimate.mean).all()
        assert (estimate.log_evidence != 0).all() == any(given)
    assert np.linalg.norm(estimate.mean - PLACES, axis=1).max() < 0.02


@pytest.mark.parametrize("settings", ALL)
def test_before_any_frame_nothing_is_known_and_the_rest_is_as_if_it_began_later(settings: FilterSettings) -> None:
    belief, estimate = step(None, [None, None], None, np.random.default_rng(0), settings, k=2)
    assert belief is None
    assert estimate.mean.shape == (2, 3)
    assert np.isnan(estimate.mean).all()
    assert estimate.pixel.shape == (2, 2, 2)
    assert not estimate.observed.any()
    np.testing.assert_array_equal(estimate.log_evidence, 0)
    _, later = step(belief, [wall(), None], None, np.random.default_rng(0), settings)
    _, first = step(None, [wall(), None], None, np.random.default_rng(0), settings)
    np.testing.assert_array_equal(later.mean, first.mean)


@pytest.mark.parametrize("settings", ALL)
def test_time_without_frames_only_makes_the_belief_wider(settings: FilterSettings) -> None:
    rng, belief = np.random.default_rng(0), None
    for _ in range(8):
        belief, before = step(belief, [wall()], None, rng, settings)
    for _ in range(20):
        belief, after = step(belief, [None], None, rng, settings)
    assert np.linalg.norm(after.mean - before.mean, axis=1).max() < 0.01
    grown = np.trace(after.covariance, axis1=1, axis2=2) / np.trace(before.covariance, axis1=1, axis2=2)
    assert (grown == 1).all() if isinstance(settings, ExpectationSettings) else (grown > 1.2).all()


def test_the_paper_and_its_code_differ_where_they_do() -> None:
    paper, code, own = (settings_named("particle", name) for name in ("paper", "code", "default"))
    assert (paper.occlusion_margin, code.occlusion_margin) == (0.05, 0.10)
    resampled = {"resample_below": 1.0, "resampling": "systematic", "redraw_sharpness": 64.0}
    assert replace(paper, occlusion_margin=0.10, hidden_without_depth=1.0, **resampled) == code
    assert (code.n_particles, code.gripper_probability, code.alpha) == (250, 0.25, 4.0)
    assert (paper.resampling, paper.resample_below, paper.redraw_sharpness) == ("stratified", 0.1, None)
    assert (code.depth_noise, code.depth_noise_floor) == (0.02, 0.001)
    assert math.isclose(code.tau, 0.25 * math.exp(-4))
    assert own == ParticleSettings()
    assert settings_named("discrete", "paper") == DiscreteSettings(
        alpha=4.0, walk_px=2.0, tau=0.0, restart=0.0, gripper_probability=0.0
    )
    assert settings_named("expectation", "paper").alpha == 4.0
    assert settings_named("expectation").alpha == 20.0


def test_what_is_given_overrides_the_named_settings_and_none_does_not() -> None:
    settings = settings_named("particle", "code", n_particles=99, tau=None, walk=0.0)
    assert settings == replace(settings_named("particle", "code"), n_particles=99, walk=0.0)


def test_a_setting_that_the_filter_does_not_have_is_refused() -> None:
    with pytest.raises(TypeError, match="n_particles"):
        settings_named("discrete", n_particles=3)


@pytest.mark.parametrize(("filter", "name"), [("partcle", "paper"), ("particle", "papr")])
def test_a_misspelt_name_is_refused(filter: str, name: str) -> None:
    expected = "expected one of expectation, discrete, particle and one of default, paper, code, got"
    with pytest.raises(ValueError, match=f"settings: {expected} {filter} and {name}"):
        inspect.unwrap(settings_named)(filter, name)  # Types are checked in tests alone.


def test_a_filter_that_is_not_in_the_table_is_refused() -> None:
    with pytest.raises(ValueError, match="filter: expected one of expectation, discrete, particle, got kalman"):
        filter_named("kalman")


@pytest.mark.parametrize(
    ("filter", "name", "asked", "alpha"),
    [
        ("expectation", "default", None, 20.0),
        ("expectation", "paper", None, 4.0),
        ("discrete", "default", None, 4.0),
        ("discrete", "default", 7.0, 7.0),
        ("discrete", "default", 0.0, 0.0),
        ("particle", "default", None, None),
        ("particle", "default", 7.0, 7.0),
        ("truth", "default", 7.0, None),
    ],
)
def test_a_temperature_of_one_frame_is_not_the_particle_filters_own(
    filter: str, name: str, asked: float | None, alpha: float | None
) -> None:
    assert alpha_of_one_frame(filter, name, asked) == alpha


def test_the_table_is_read_without_numpy() -> None:
    code = "import sys, bask_data.core.filters.table; sys.exit('numpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0
