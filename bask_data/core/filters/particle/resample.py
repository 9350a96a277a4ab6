"""Preparation of the belief for the next frame: resampling, and the lightest particles redrawn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from numpy.random import Generator

from bask_data.core.filters.observation import Estimate, Observation
from bask_data.core.filters.particle.belief import ParticleBelief
from bask_data.core.filters.particle.draw import draw
from bask_data.core.filters.particle.likelihood import FrameLikelihood
from bask_data.core.filters.particle.lookalikes import known_lookalikes, matched_now, usual_match, with_lookalikes
from bask_data.core.filters.particle.settings import ParticleSettings


def refresh(
    belief: ParticleBelief,
    estimate: Estimate,
    likelihoods: Sequence[FrameLikelihood],
    observations: Sequence[Observation],
    rng: Generator,
    settings: ParticleSettings,
) -> ParticleBelief:
    """The belief for the next frame: resampled where the effective sample size is low, the lightest particles redrawn
    from the heat maps.

    Where the track is seen, points drawn far from it are distractors and remembered; points drawn near one get no
    weight. Frames are not independent: a distractor that stays in view would soon outweigh any position that is not,
    however small its first weight.

    Source: von Hartz et al. 2023, Sec. III-B.5.
    """
    k, n = belief.weight.shape
    spread = rng.random((n,))
    if settings.resampling == "systematic":
        spread = np.full_like(spread, spread[0])
    matched, tau = matched_now(belief, likelihoods)
    belief = replace(_resampled(belief, spread, settings), usual_match=usual_match(belief, matched, tau, settings))
    n_new = round(settings.redraw_share * n)
    usable = [seen for seen in observations if (seen.depth > 0).any()]
    ties = 1.0 + 1e-6 * rng.random(n)  # With equal weights, the choice would depend on the sorting algorithm.
    if not n_new or not usable:
        return belief
    parts = [len(part) for part in np.array_split(np.arange(n_new), len(usable))]
    sharpness = settings.draw_sharpness if settings.redraw_sharpness is None else settings.redraw_sharpness
    drawing = replace(settings, draw_sharpness=sharpness)
    drawn = [
        draw(seen, n_here, rng, drawing, settings.draw_block)
        for seen, n_here in zip(usable, parts, strict=True)
        if n_here
    ]
    new = np.concatenate([one.points_world for one in drawn], axis=1)
    match = np.concatenate([one.match for one in drawn], axis=1)
    share, is_new = np.full(k, settings.redraw_mass), np.ones(match.shape, dtype=bool)
    if settings.n_lookalikes:
        share *= np.where(belief.usual_match > 0, 1.0 - matched, settings.unfound_mass)
        is_new = ~known_lookalikes(belief, new, match, settings)
        belief = with_lookalikes(belief, estimate, matched, new, match, settings)
    at = (
        np.arange(k)[:, None],
        np.sort(np.argpartition((belief.weight + 1e-300) * ties, n_new, axis=1)[:, :n_new], axis=1),
    )
    points, weight, held = belief.points_world.copy(), belief.weight.copy(), belief.held.copy()
    points[at], held[at], weight[at] = new, False, 0.0
    weight /= weight.sum(axis=1, keepdims=True)
    weight[at] = is_new * share[:, None] / n_new
    weight /= weight.sum(axis=1, keepdims=True)
    return replace(belief, points_world=points, weight=weight, held=held)


def _resampled(belief: ParticleBelief, spread: Float[ndarray, "n"], settings: ParticleSettings) -> ParticleBelief:
    """Particles resampled to equal weights where the effective sample size is low, else unchanged."""
    k, n = belief.weight.shape
    few = 1.0 / np.einsum("kn,kn->k", belief.weight, belief.weight) < settings.resample_below * n
    if not few.any():
        return belief
    chosen = np.tile(np.arange(n), (k, 1))
    for i in map(int, np.flatnonzero(few)):
        chosen[i] = stratified(belief.weight[i], spread)
    at = np.arange(k)[:, None], chosen
    weight = np.where(few[:, None], 1.0 / n, belief.weight)
    return replace(belief, points_world=belief.points_world[at], weight=weight, held=belief.held[at])


def stratified(weight: Float[ndarray, "m"], uniform: Float[ndarray, "n"]) -> Int[ndarray, "n"]:
    """Indices of n particles, one from each n-th of the cumulated weight: i appears n weight[i] times in expectation.
    With n equal random numbers it is systematic resampling.

    Args:
        uniform: in [0, 1).
    """
    n = len(uniform)
    total = np.cumsum(weight)
    return np.searchsorted(total, (np.arange(n) + uniform) / n * total[-1], side="right").clip(max=len(weight) - 1)
