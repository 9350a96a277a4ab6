"""The covariance that the particle filter reports, on walls whose descriptors are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bask_data.core.filters.observation import Estimate, Observation
from bask_data.core.filters.particle import certainty, particle_step
from bask_data.core.filters.particle.belief import ParticleBelief, new_belief
from bask_data.core.filters.particle.certainty import (
    HIGHEST_ALPHA,
    MOST_DISPLACED,
    RESIDUAL_RATE,
    SLOPE_RATE,
    Residuals,
)
from bask_data.core.filters.particle.settings import ParticleSettings
from bask_data.core.track_scores import spread

HEIGHT, WIDTH, FOCAL = 60, 120, 200.0
K = np.array([[FOCAL, 0, 59.5], [0, FOCAL, 29.5], [0, 0, 1]])
DISTANCE = 0.4
"""Metres from the camera to the wall, of which a pixel covers 2 mm."""
OWN = ParticleSettings()


def wall(keypoint: float, edge: float = np.inf, turned: bool = False) -> Observation:
    """A wall; beyond the edge, it shows something else than the keypoint's surroundings.

    Args:
        keypoint, edge: metres along x.
        turned: whether the camera faces away from it.
    """
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    x, y = (u - K[0, 2]) / FOCAL * DISTANCE, (v - K[1, 2]) / FOCAL * DISTANCE
    z = np.minimum(20 * np.hypot(x - keypoint, y), 2.0)
    z[x > edge] = 2.0
    world_from_camera = np.diag([-1.0, 1.0, -1.0, 1.0]) if turned else np.eye(4)
    depth = np.full((HEIGHT, WIDTH), DISTANCE, dtype=np.float32)
    return Observation(z[None].astype(np.float32), depth, K, world_from_camera)


def followed(frames: list[Observation], settings: ParticleSettings = OWN) -> tuple[ParticleBelief, list[Estimate]]:
    belief, rng, estimates = None, np.random.default_rng(0), []
    for frame in frames:
        belief, estimate = particle_step(belief, [frame], None, rng, settings)
        estimates.append(estimate)
    assert belief is not None
    return belief, estimates


def spread_of(estimate: Estimate) -> float:
    return float(spread(estimate.covariance[None])[0, 0])


def error_of(estimate: Estimate, keypoint: float) -> float:
    return float(np.linalg.norm(estimate.mean[0] - [keypoint, 0, DISTANCE]))


def test_behind_an_edge_the_spread_is_as_large_as_the_error_and_in_plain_view_as_small() -> None:
    _, plain_view = followed([wall(0.02)] * 15)
    _, behind = followed([wall(0.02, edge=0.0)] * 15)
    seen, hidden = plain_view[-1], behind[-1]
    assert error_of(seen, 0.02) < 0.002 < 0.015 < error_of(hidden, 0.02) < 0.03
    assert spread_of(seen) < 0.003
    assert 0.6 * error_of(hidden, 0.02) < spread_of(hidden) < 1.5 * error_of(hidden, 0.02)
    alone = replace(OWN, residual_sigma=0.0)
    spreads = [spread_of(followed([frame] * 15, alone)[1][-1]) for frame in (wall(0.02), wall(0.02, edge=0.0))]
    assert spreads[1] == pytest.approx(spreads[0], rel=0.4), "the particles alone cannot tell"


def test_the_track_does_not_depend_on_the_covariance_that_is_reported() -> None:
    frames = [wall(0.02)] * 6 + [wall(0.02, edge=0.0)] * 6
    for one, other in zip(followed(frames)[1], followed(frames, replace(OWN, residual_sigma=0.0))[1], strict=True):
        np.testing.assert_array_equal(one.mean, other.mean)
        np.testing.assert_array_equal(one.observed, other.observed)


@pytest.mark.parametrize("preset", ["paper", "code"])
def test_the_presets_of_the_sources_report_the_spread_of_the_particles(preset: str) -> None:
    from bask_data.core.filters.table import settings_named

    assert settings_named("particle", preset).residual_sigma == 0  # type: ignore[arg-type, attr-defined]
    belief, estimates = followed([wall(0.0)], replace(OWN, residual_sigma=0.0, redraw_share=0.0, resample_below=0.0))
    offset = belief.points_world[0] - estimates[0].mean[0]
    expected = np.einsum("n,ni,nj->ij", belief.weight[0], offset, offset)
    np.testing.assert_allclose(estimates[0].covariance[0], expected, atol=1e-12)


def test_while_no_camera_sees_the_keypoint_the_displacement_is_kept_and_the_spread_grows() -> None:
    belief, estimates = followed([wall(0.02, edge=0.0)] * 15 + [wall(0.02, turned=True)] * 10)
    before, _ = followed([wall(0.02, edge=0.0)] * 15)
    np.testing.assert_array_equal(belief.displacement, before.displacement)
    assert spread_of(estimates[-1]) > spread_of(estimates[15])


def test_without_a_frame_nothing_is_learned() -> None:
    belief, _ = followed([wall(0.02)] * 5)
    after, estimate = particle_step(belief, [None], None, np.random.default_rng(0))
    assert after is not None
    np.testing.assert_array_equal(after.displacement, belief.displacement)
    assert np.isfinite(estimate.covariance).all()


def test_a_keypoint_that_was_never_found_reports_all_of_the_particles_spread() -> None:
    blank = replace(wall(0.0), distance=np.full((1, HEIGHT, WIDTH), 2.0, dtype=np.float32))
    own, alone = (followed([blank] * 4, settings)[1][-1] for settings in (OWN, replace(OWN, residual_sigma=0.0)))
    assert spread_of(alone) <= spread_of(own) < spread_of(alone) + MOST_DISPLACED


def test_two_hypotheses_far_apart_keep_their_spread() -> None:
    frame = wall(-0.08)
    both = replace(frame, distance=np.minimum(frame.distance, wall(0.08).distance))
    _, estimates = followed([both] * 4)
    assert spread_of(estimates[-1]) > 0.06


# Displacement from residuals ------------------------------------------------------------------------------------------


def residuals(at_mean: float, slope: float, sees: float = 1.0) -> Residuals:
    return Residuals(*(np.array([value]) for value in (sees, at_mean, slope)))


def displaced(*frames: list[Residuals], noise: float = 0.0) -> ParticleBelief:
    belief = new_belief(np.zeros((1, 1, 3)), np.ones((1, 1)))
    for looks in frames:
        belief = certainty._with_displacement(belief, looks, replace(OWN, alpha=4.0, residual_noise=noise / 4.0))
    return belief


def test_the_displacement_is_the_distance_over_which_the_match_falls_as_far() -> None:
    assert displaced([residuals(0.8, slope=40.0)]).displacement == pytest.approx(0.02)
    assert displaced([residuals(0.8, slope=40.0)], noise=0.2).displacement == pytest.approx(0.015)
    assert displaced([residuals(0.1, slope=40.0)], noise=0.2).displacement == 0
    assert displaced([residuals(8.0, slope=40.0)]).displacement == MOST_DISPLACED


def test_the_camera_with_the_better_match_counts_and_the_slope_is_that_of_all() -> None:
    belief = displaced([residuals(0.9, slope=20.0), residuals(0.3, slope=40.0)])
    assert belief.slope == pytest.approx(30.0)
    assert belief.displacement == pytest.approx(0.01)


@pytest.mark.parametrize("look", [residuals(0.1, 40.0, sees=0.5), residuals(30.0, 40.0)])
def test_a_camera_that_hardly_sees_the_keypoint_or_looks_past_it_does_not_count(look: Residuals) -> None:
    belief = displaced([residuals(0.8, slope=40.0)], [look])
    assert belief.displacement == pytest.approx(0.02)
    assert np.isnan(displaced([look]).displacement).all()


def test_slope_and_displacement_are_running_averages() -> None:
    belief = displaced([residuals(0.8, slope=40.0)], [residuals(0.4, slope=20.0)])
    slope = 40.0 - SLOPE_RATE * 20.0
    assert belief.slope == pytest.approx(slope)
    assert belief.displacement == pytest.approx(0.02 + RESIDUAL_RATE * (0.4 / slope - 0.02))


def test_without_a_slope_only_the_largest_displacement_is_known() -> None:
    assert displaced([residuals(0.8, slope=-5.0)]).displacement == MOST_DISPLACED
    assert displaced([residuals(0.0, slope=-5.0)]).displacement == 0
    flat_later = displaced([residuals(0.8, slope=40.0)], [residuals(0.8, slope=-5.0)])
    assert flat_later.slope == pytest.approx(40.0)


def test_with_a_higher_temperature_the_spread_of_the_particles_is_reported() -> None:
    frames = [wall(0.02, edge=0.0)] * 6
    for alpha, differs in ((HIGHEST_ALPHA, True), (1.01 * HIGHEST_ALPHA, False)):
        reported, plain = (
            followed(frames, replace(OWN, alpha=(alpha,), residual_sigma=sigma))[1][-1].covariance
            for sigma in (OWN.residual_sigma, 0.0)
        )
        assert np.array_equal(reported, plain) != differs
