"""Memory of distractors: positions that matched while the keypoint was seen elsewhere."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from bask_data.core.filters.observation import Estimate
from bask_data.core.filters.particle.belief import ParticleBelief
from bask_data.core.filters.particle.likelihood import FrameLikelihood
from bask_data.core.filters.particle.settings import ParticleSettings


def matched_now(
    belief: ParticleBelief, looks: Sequence[FrameLikelihood]
) -> tuple[Float[ndarray, "k"], Float[ndarray, "k"]]:
    """p_d p_c of the track, at most one, in the camera that sees it best; and that camera's tau."""
    if not looks:
        return np.zeros(len(belief.weight)), np.ones(len(belief.weight))
    matched = np.stack([np.einsum("kn,kn->k", belief.weight, one.seen) for one in looks])
    best = matched.argmax(axis=0), np.arange(matched.shape[1])
    return np.minimum(matched[best], 1.0), np.stack([one.tau for one in looks])[best]


def usual_match(
    belief: ParticleBelief, matched: Float[ndarray, "k"], tau: Float[ndarray, "k"], settings: ParticleSettings
) -> Float[ndarray, "k"]:
    """The running average of a track's match after a frame.

    Args:
        matched, tau: of `matched_now`.
    """
    rate = np.where(belief.usual_match > 0, settings.usual_rate, 1.0)
    return belief.usual_match + np.where(matched > settings.found * tau, rate, 0.0) * (matched - belief.usual_match)


def known_lookalikes(
    belief: ParticleBelief,
    points_world: Float[ndarray, "k n 3"],
    match: Float[ndarray, "k n"],
    settings: ParticleSettings,
) -> Bool[ndarray, "k n"]:
    """Points near a known distractor that match no better than it did."""
    apart = np.linalg.norm(points_world[:, :, None] - belief.lookalikes[:, None], axis=-1)
    same = (apart < settings.lookalike_radius) & (
        match[:, :, None] < settings.lookalike_better * belief.lookalike_match[:, None]
    )
    return same.any(axis=-1)


def with_lookalikes(
    belief: ParticleBelief,
    estimate: Estimate,
    matched: Float[ndarray, "k"],
    points_world: Float[ndarray, "k n 3"],
    match: Float[ndarray, "k n"],
    settings: ParticleSettings,
) -> ParticleBelief:
    """The belief with new distractors: points that match as well as a track that is seen and certain, but are far from
    it.

    Args:
        points_world, match: drawn points and exp(-alpha z) at each.
    """
    spread = np.sqrt(np.trace(estimate.covariance, axis1=1, axis2=2))
    sure = (belief.usual_match > 0) & (spread < 0.5 * settings.lookalike_radius)
    far = np.linalg.norm(points_world - estimate.mean[:, None], axis=-1) > settings.lookalike_radius
    other = sure[:, None] & far & (match < settings.lookalike_better * matched[:, None])
    m = belief.lookalikes.shape[1]
    places, values = belief.lookalikes.copy(), belief.lookalike_match.copy()
    for i in map(int, np.flatnonzero(other.any(axis=1))):
        places[i] = np.concatenate([points_world[i, other[i]], places[i]])[:m]
        values[i] = np.concatenate([match[i, other[i]], values[i]])[:m]
    return replace(belief, lookalikes=places, lookalike_match=values)
