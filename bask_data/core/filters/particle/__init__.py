"""The particle filter: for each keypoint, weighted points in the world frame, seen by any number of cameras or none.

All keypoints share one stream of random numbers, drawn once per particle, not per keypoint. A keypoint's track then
does not depend on which others are tracked, and drawing costs the same for one as for sixteen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.random import Generator

from bask_data.core.filters.observation import Estimate, Motion, Observation, WeightedPoints, n_keypoints, nothing_known
from bask_data.core.filters.particle.belief import ParticleBelief, normalised
from bask_data.core.filters.particle.certainty import with_certainty
from bask_data.core.filters.particle.draw import first_particles
from bask_data.core.filters.particle.estimate import estimate_of
from bask_data.core.filters.particle.likelihood import frame_likelihood
from bask_data.core.filters.particle.motion import move
from bask_data.core.filters.particle.resample import refresh
from bask_data.core.filters.particle.settings import IF_CALIBRATED, PRESETS, ParticleSettings
from bask_data.core.filters.table import Filter

_OWN = ParticleSettings()


def particle_step(
    belief: ParticleBelief | None,
    observations: Sequence[Observation | None],
    motion: Motion | None = None,
    rng: Generator | None = None,
    settings: ParticleSettings = _OWN,
) -> tuple[ParticleBelief | None, Estimate]:
    """Belief and estimate after one more frame. Without a belief, particles are drawn from the heat maps.

    The estimate is that of the weighted particles, before resampling adds noise; its covariance is that of
    `with_certainty`, which no later frame depends on. Until a camera measures depth, there
    is nothing to draw from: the belief stays None and the estimate NaN. A camera without a frame is no evidence;
    without any frame, particles only move.

    Source: von Hartz et al. 2023, Sec. III-B, Eq. 2 and 10.
    """
    rng = np.random.default_rng(0) if rng is None else rng
    given = [seen for seen in observations if seen is not None]
    if belief is None:
        drawn = first_particles(given, rng, settings)
        if drawn is None:
            return None, nothing_known(len(observations), n_keypoints(observations))
        belief, likelihoods, log_evidence = drawn
    else:
        belief = move(belief, motion, rng, settings)
        likelihoods = [frame_likelihood(belief.points_world, seen, settings, belief.usual_match) for seen in given]
        with np.errstate(divide="ignore"):
            log_weight = np.log(belief.weight)
        for one in likelihoods:
            log_weight = log_weight + np.log(one.likelihood)
        weight, log_evidence = normalised(log_weight)
        belief = replace(belief, weight=weight)
    estimate = estimate_of(belief, likelihoods, observations, log_evidence, settings.mode_radius)
    belief, reported = with_certainty(belief, estimate, likelihoods, given, settings)
    return refresh(belief, estimate, likelihoods, given, rng, settings), reported


def weighted_particles(
    belief: ParticleBelief | None, observations: Sequence[Observation | None], settings: ParticleSettings
) -> WeightedPoints:
    """The particles; none before the first measured depth."""
    if belief is None:
        k = n_keypoints(observations)
        return WeightedPoints(np.zeros((k, 0, 3)), np.zeros((k, 0)))
    return WeightedPoints(belief.points_world, belief.weight)


FILTER = Filter(
    settings=ParticleSettings,
    belief=ParticleBelief,
    step=particle_step,
    hypotheses=weighted_particles,
    presets=PRESETS,
    if_calibrated=IF_CALIBRATED,
    alpha_is_of_one_frame=False,
)
