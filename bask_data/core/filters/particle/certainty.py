"""The covariance that the particle filter reports: how far the keypoint may be from the estimate.

The spread of the particles says how far apart the hypotheses are, not how wrong they all may be. Behind an edge, all
of them settle at the nearest surface that is visible, close together and wrong by the same centimetre; in plain view,
they spread over a centimetre around a mean that is right to a millimetre. What differs is how well the mean matches.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from bask_data.core.compiled import compiled
from bask_data.core.filters.observation import Estimate, Observation
from bask_data.core.filters.particle.belief import ParticleBelief
from bask_data.core.filters.particle.likelihood import FrameLikelihood, frame_likelihood
from bask_data.core.filters.particle.settings import ParticleSettings
from bask_data.core.filters.per_keypoint import per_keypoint

SEES = 0.7
"""Least probability that a camera sees the keypoint for its residual to count. With 0.5 and 0.9, the calibration error
changes by less than 0.01."""
UNREADABLE = 16.0
"""Residual, natural logarithm, from which on the mean is taken to be off the surface or the image, where it tells
nothing of the distance. Chosen, sensitivity not measured."""
RESIDUAL_RATE = 0.5
"""Weight of a frame in the running average of the displacement. Half or twice as much raises the calibration error by
0.00 and 0.02."""
SLOPE_RATE = 0.1
"""Weight of a frame in the running average of the slope. Half or twice as much raises the calibration error by 0.02 and
0.00."""
HIGHEST_ALPHA = 2.2
"""Temperature up to which the displacement is read: a tenth above the one that its settings were chosen with. With a
higher one, which is measured for networks whose usual match is far from zero, the usual match would be taken for an
error. Calibration error with and without the displacement: 0.29 and 0.12 in the 7-Scenes kitchen, alpha 2.7 to 3.4;
0.16 and 0.33, 0.14 and 0.33 on simulated `lid` and `rubbish` with a trained network, alpha 2 to 2.1."""
MOST_DISPLACED = 0.1
"""Largest displacement, metres. Assumes a tabletop. Half or twice as much changes the calibration error by less than
0.01."""


@dataclass(frozen=True)
class Residuals:
    """How well a keypoint matches in one camera, by the natural logarithm of p_d p_c with its sign changed.

    Attributes:
        sees: probability that the camera sees the keypoint.
        at_mean: residual at the mean of the particles.
        slope: by how much it is larger at the particles that are seen, for each metre of their distance from the mean;
            not positive where the mean is no better a match than they are.
    """

    sees: Float[ndarray, "k"]
    at_mean: Float[ndarray, "k"]
    slope: Float[ndarray, "k"]

    @property
    def counts(self) -> Bool[ndarray, "k"]:
        """Whether the camera sees the keypoint and the residual can be read."""
        return (self.sees > SEES) & (self.at_mean < UNREADABLE)


def with_certainty(
    belief: ParticleBelief,
    estimate: Estimate,
    likelihoods: Sequence[FrameLikelihood],
    observations: Sequence[Observation],
    settings: ParticleSettings,
) -> tuple[ParticleBelief, Estimate]:
    """The belief with this frame's displacement, and the estimate with the covariance that is reported:

        (p a_seen^2 + (1 - p) a_unseen^2) Sigma + (b d)^2 / 3 I

    Sigma is the weighted covariance of the particles, p the probability that a camera sees the keypoint, d the
    displacement: the distance over which the match falls as far as it has fallen at the mean, (residual - noise) /
    slope, averaged over frames. While no camera sees the keypoint, d is kept. Both factors are one while a keypoint has
    never been found, and where the particles spread further than `lookalike_radius`, as there is then more than one
    hypothesis. Where `residual_sigma` is zero, and for keypoints whose alpha is above `HIGHEST_ALPHA`, Sigma alone is
    reported.

    Args:
        likelihoods, observations: of the cameras with a frame, in order.
    """
    if settings.residual_sigma == 0:
        return belief, estimate
    looks = [_residuals(belief, estimate.mean, *look, settings) for look in zip(likelihoods, observations, strict=True)]
    belief = _with_displacement(belief, looks, settings)
    sees = np.max([np.zeros(len(estimate.mean)), *(look.sees for look in looks)], axis=0)
    share = sees * settings.spread_seen**2 + (1 - sees) * settings.spread_unseen**2
    is_one_place = (belief.usual_match > 0) & (
        np.trace(estimate.covariance, axis1=1, axis2=2) < settings.lookalike_radius**2
    )
    is_read = per_keypoint(settings.alpha, len(share), "alpha") <= HIGHEST_ALPHA
    share = np.where(is_one_place & is_read, share, 1.0)
    displaced = is_read * (settings.residual_sigma * np.nan_to_num(belief.displacement)) ** 2 / 3
    covariance = share[:, None, None] * estimate.covariance + displaced[:, None, None] * np.eye(3)
    return belief, replace(estimate, covariance=covariance)


def _residuals(
    belief: ParticleBelief,
    mean: Float[ndarray, "k 3"],
    look: FrameLikelihood,
    seen: Observation,
    settings: ParticleSettings,
) -> Residuals:
    """How well a keypoint matches in one camera."""
    # `seen` does not depend on tau, which would be computed from the whole image.
    there = frame_likelihood(mean[:, None], seen, replace(settings, tau=1.0))
    at_mean = -np.log(np.maximum(there.seen[:, 0], np.finfo(np.float64).tiny))
    sees, around, apart = _around(belief.points_world, mean, belief.weight, look.likelihood, look.seen)
    return Residuals(sees, at_mean, (around - at_mean) / np.maximum(apart, 1e-9))


@compiled
def _around(
    points: ndarray, mean: ndarray, weight: ndarray, likelihood: ndarray, seen: ndarray
) -> tuple[ndarray, ndarray, ndarray]:
    """Probability that the keypoint is seen, and for the particles that are, their mean residual and distance from the
    mean (k,)."""
    sees, residual, apart = np.zeros(len(points)), np.zeros(len(points)), np.zeros(len(points))
    for i in range(points.shape[0]):
        for j in range(points.shape[1]):
            share = weight[i, j] * seen[i, j] / likelihood[i, j]
            if share > 0.0:
                x, y, z = points[i, j, 0] - mean[i, 0], points[i, j, 1] - mean[i, 1], points[i, j, 2] - mean[i, 2]
                sees[i] += share
                residual[i] -= share * np.log(seen[i, j])
                apart[i] += share * np.sqrt(x * x + y * y + z * z)
        if sees[i] > 0.0:
            residual[i] /= sees[i]
            apart[i] /= sees[i]
    return sees, residual, apart


def _with_displacement(
    belief: ParticleBelief, looks: Sequence[Residuals], settings: ParticleSettings
) -> ParticleBelief:
    """The belief with running averages of slope and displacement, which start with their first value.

    The slope is that of the keypoint's descriptor, the same in all cameras. The displacement is that of the camera in
    which the mean matches best: in another one, the keypoint may be behind an edge.
    """
    if not looks:
        return belief
    counts = np.stack([look.counts for look in looks])
    slopes = np.stack([look.slope for look in looks])
    rises = counts & (slopes > 0)
    n_rising, n_counting = rises.sum(axis=0), counts.sum(axis=0)
    slope = np.where(rises, slopes, 0.0).sum(axis=0) / np.maximum(n_rising, 1)
    slope = _averaged(belief.slope, slope, n_rising > 0, SLOPE_RATE)
    least = np.where(counts, [look.at_mean for look in looks], np.inf).min(axis=0)
    noise = settings.residual_noise * per_keypoint(settings.alpha, len(least), "alpha")
    beyond = np.maximum(np.where(n_counting > 0, least, 0.0) - noise, 0.0)
    known_slope = np.where(slope > 0, slope, 1e-9)  # Without any, nothing but MOST_DISPLACED is known.
    displacement = np.minimum(beyond / known_slope, MOST_DISPLACED)
    displacement = _averaged(belief.displacement, displacement, n_counting > 0, RESIDUAL_RATE)
    return replace(belief, slope=slope, displacement=displacement)


def _averaged(
    before: Float[ndarray, "k"], value: Float[ndarray, "k"], is_new: Bool[ndarray, "k"], rate: float
) -> Float[ndarray, "k"]:
    """A running average, NaN before its first value."""
    now = np.where(np.isnan(before), value, before + rate * (value - before))
    return np.where(is_new, now, before)
