"""Particles drawn from the heat maps of a frame: the first ones, and those redrawn in later frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from numpy.random import Generator

from bask_data.core.filters.heatmap import softmax_map
from bask_data.core.filters.observation import Observation
from bask_data.core.filters.particle.belief import ParticleBelief, new_belief, normalised
from bask_data.core.filters.particle.likelihood import FrameLikelihood, frame_likelihood
from bask_data.core.filters.particle.settings import ParticleSettings
from bask_data.core.filters.per_keypoint import per_keypoint
from bask_data.core.geometry import transform, unproject
from bask_data.core.nearest_depth import shrink_depth


@dataclass(frozen=True)
class DrawnPoints:
    """Points drawn from a heat map, and exp(-alpha z) at each."""

    points_world: Float[ndarray, "k n 3"]
    match: Float[ndarray, "k n"]


def draw(seen: Observation, n: int, rng: Generator, settings: ParticleSettings, block: int = 1) -> DrawnPoints:
    """n points per keypoint on the measured surface, from the heat map, with the noise of a pixel and of depth.

    Args:
        block: consider one random pixel only of each block x block pixels.
    """
    height, width = seen.distance.shape[1:]
    depth = shrink_depth(seen.depth, (height, width))
    v, u = np.mgrid[:height:block, :width:block]
    if block > 1:
        v = np.minimum(v + rng.integers(block, size=v.shape), height - 1)
        u = np.minimum(u + rng.integers(block, size=u.shape), width - 1)
    measured = depth[v, u] > 0
    if measured.any():
        v, u = v[measured], u[measured]
    else:
        v, u = np.nonzero(depth > 0)
    z = seen.distance[:, v, u]
    alpha = per_keypoint(settings.alpha, len(z), "alpha").astype(z.dtype)[:, None]
    sharp = settings.draw_sharpness * alpha
    total = np.cumsum(np.exp(-sharp * (z - z.min(axis=1, keepdims=True)), dtype=np.float64), axis=1)
    at = (np.arange(n) + rng.random(n)) / n
    chosen = np.stack([np.searchsorted(row, at * row[-1], side="right") for row in total]).clip(max=len(v) - 1)
    scale = np.array([seen.depth.shape[1] / width, seen.depth.shape[0] / height])
    cell = np.stack([u[chosen], v[chosen]], axis=-1) + rng.uniform(-0.5, 0.5, (n, 2))
    z_d = depth[v[chosen], u[chosen]].astype(np.float64)
    z_d = z_d + rng.standard_normal(n) * (settings.depth_noise * z_d + settings.depth_noise_floor)
    points = transform(seen.world_from_camera, unproject((cell + 0.5) * scale - 0.5, z_d, seen.K))
    return DrawnPoints(points, np.exp(-alpha * np.take_along_axis(z, chosen, axis=1), dtype=np.float64))


def first_particles(
    observations: Sequence[Observation], rng: Generator, settings: ParticleSettings
) -> tuple[ParticleBelief, list[FrameLikelihood], Float[ndarray, "k"]] | None:
    """Particles drawn from the first heat maps, their likelihoods and the log evidence; None without any depth.

    Each camera with depth draws an equal share. These are weighted by the other cameras, as their own camera's frame is
    in the draw.
    """
    usable = [i for i, seen in enumerate(observations) if (seen.depth > 0).any()]
    if not usable:
        return None
    n = settings.n_particles
    owner = np.sort(np.resize(usable, n))
    drawn = [draw(observations[i], int((owner == i).sum()), rng, settings) for i in usable]
    points = np.concatenate([one.points_world for one in drawn], axis=1)
    looks = [frame_likelihood(points, seen, settings) for seen in observations]
    log_weight = np.full(points.shape[:2], -np.log(n))
    for i, one in enumerate(looks):
        log_weight = log_weight + np.where(owner == i, 0.0, np.log(one.likelihood))
    weight, log_others = normalised(log_weight)
    log_own = np.mean([softmax_map(observations[i].distance, settings.alpha)[1] for i in usable], axis=0)
    return new_belief(points, weight, settings.n_lookalikes), looks, log_own + log_others
