"""The estimate from weighted particles: mean, covariance and mode."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from bask_data.core.compiled import compiled
from bask_data.core.filters.observation import Estimate, Observation, projections
from bask_data.core.filters.particle.belief import ParticleBelief
from bask_data.core.filters.particle.likelihood import FrameLikelihood
from bask_data.core.filters.particle.resample import stratified

N_MODES = 32
"""Number of particles that are candidates for the mode, evenly over the cumulated weight: a hypothesis with a
thirtieth of the weight has one. Chosen, sensitivity not measured."""


def estimate_of(
    belief: ParticleBelief,
    likelihoods: Sequence[FrameLikelihood],
    observations: Sequence[Observation | None],
    log_evidence: Float[ndarray, "k"],
    mode_radius: float,
) -> Estimate:
    """The estimate from weighted particles.

    Args:
        likelihoods: of the cameras with a frame, in order.
        observations: of all cameras, None for one without a frame.
        mode_radius: metres around the mode that count as one hypothesis.
    """
    points, weight = belief.points_world, belief.weight
    mean = np.einsum("kn,kni->ki", weight, points)
    offset = points - mean[:, None]
    observed = np.zeros((len(observations), len(points)), dtype=bool)
    given = [i for i, seen in enumerate(observations) if seen is not None]
    for i, one in zip(given, likelihoods, strict=True):
        observed[i] = np.einsum("kn,kn->k", weight, one.seen / one.likelihood) > 0.5
    return Estimate(
        mean=mean,
        covariance=np.einsum("kn,kni,knj->kij", weight, offset, offset, optimize=True),
        mode=mode(points, weight, mode_radius),
        n_eff=1.0 / np.einsum("kn,kn->k", weight, weight),
        log_evidence=log_evidence,
        pixel=projections(mean, observations),
        observed=observed,
    )


def mode(points: Float[ndarray, "k n 3"], weight: Float[ndarray, "k n"], radius: float) -> Float[ndarray, "k 3"]:
    """Mean of the ball of particles with the most weight, among balls around `N_MODES` of them.

    A histogram would be cheaper, but a cluster divided by its cells loses against a lighter one that is not.

    Args:
        radius: of the balls, metres.
    """
    centres = np.stack([own[stratified(w, np.full(N_MODES, 0.5))] for own, w in zip(points, weight, strict=True)])
    centre = centres[np.arange(len(points)), _mass_around(centres, points, weight, radius).argmax(axis=1)]
    return _refined(centre, points, weight, radius)


@compiled
def _refined(centres: ndarray, points: ndarray, weight: ndarray, radius: float) -> ndarray:
    """Means of the balls (k, 3), moved to them three times; a ball without weight stays."""
    refined = centres.copy()
    for k in range(centres.shape[0]):
        for _ in range(3):
            total, u, v, w = 0.0, 0.0, 0.0, 0.0
            x, y, z = refined[k, 0], refined[k, 1], refined[k, 2]
            for n in range(points.shape[1]):
                a, b, d = points[k, n, 0] - x, points[k, n, 1] - y, points[k, n, 2] - z
                if a * a + b * b + d * d < radius * radius:
                    total += weight[k, n]
                    u += weight[k, n] * a
                    v += weight[k, n] * b
                    w += weight[k, n] * d
            if total > 0.0:
                refined[k, 0], refined[k, 1], refined[k, 2] = x + u / total, y + v / total, z + w / total
    return refined


@compiled
def _mass_around(centres: ndarray, points: ndarray, weight: ndarray, radius: float) -> ndarray:
    """Weight of the points within a radius of each centre (k, c)."""
    mass = np.zeros(centres.shape[:2])
    for k in range(centres.shape[0]):
        for c in range(centres.shape[1]):
            x, y, z = centres[k, c, 0], centres[k, c, 1], centres[k, c, 2]
            for n in range(points.shape[1]):
                a, b, d = points[k, n, 0] - x, points[k, n, 1] - y, points[k, n, 2] - z
                if a * a + b * b + d * d < radius * radius:
                    mass[k, c] += weight[k, n]
    return mass
