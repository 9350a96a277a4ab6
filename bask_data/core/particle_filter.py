"""The particle filter: for each keypoint weighted points in the world frame, seen by any number of cameras, or by none.

All keypoints share one stream of random numbers, drawn once per particle and not once per keypoint. A keypoint's track
therefore does not depend on which others are tracked beside it, and drawing costs the same for one as for sixteen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from numpy.random import Generator
from scipy.special import ndtr

from bask_data.core.geometry import in_image, invert_rigid, project, transform, unproject
from bask_data.core.heatmap import (
    Estimate,
    Motion,
    Observation,
    n_keypoints,
    nothing_known,
    projections,
    shrink_depth,
    softmax_map,
    unseen_likelihood,
)

LEAST_LIKELIHOOD = 1e-30
"""Stands for zero: a particle that cannot be right keeps a weight, so that not even a set without any right one has
none."""

DRAW_BLOCK = 4
"""Edge, pixels, of the blocks of which one pixel each is looked at when a few particles are drawn anew."""

MODE_RADIUS = 0.03
"""Metres around the mode within which particles count as one hypothesis."""

N_MODES = 32
"""Number of particles whose surroundings are weighed in search of the mode."""


@dataclass(frozen=True)
class ParticleSettings:
    """Settings of the particle filter."""

    n_particles: int = 2000
    alpha: float = 4.0
    """Temperature: a pixel at distance z has correspondence likelihood exp(-alpha z)."""
    tau: float | None = None
    """Likelihood of any observation if the camera does not see the particle; None: `unseen_likelihood` says it of each
    frame."""
    tau_ratio: float = 2.0
    """Without `tau`: how much likelier the keypoint is out of sight than at the average pixel."""
    walk: float = 0.002
    """Standard deviation of the random walk in one frame and along each axis, metres."""
    gripper_probability: float = 0.5
    """Probability that a particle near the gripper takes part in the gripper's motion."""
    gripper_memory: float = 0.0
    """Probability that it does in a frame what it did in the last: what is held stays held. Zero for the paper's model,
    in which every frame is drawn anew."""
    gripper_reach: float = 0.15
    """Metres around the gripper's frame within which particles may move with it. Infinity for the paper's model."""
    gripper_turns: bool = True
    """Whether particles take part in the gripper's rotation, too. The authors' take part in its translation only."""
    depth_noise: float = 0.02
    """Standard deviation of depth, as a share of depth ..."""
    depth_noise_floor: float = 0.001
    """... and what is added to it, metres."""
    hidden_without_depth: float = 0.5
    """p_o at a pixel without depth. The authors' is 1: such a pixel says nothing at all."""
    occlusion_margin: float = 0.05
    """Metres by which something must lie in front of a particle to hide it."""
    resample_below: float = 0.1
    """Resample when the effective number of particles is below this share of all."""
    resampling: Literal["stratified", "systematic"] = "stratified"
    """One random number for each new particle, or one for all of them."""
    draw_sharpness: float = 3.0
    """How much higher than alpha the temperature is of the heat maps that particles are drawn from, first and later:
    alpha is made for many frames together, and in a single one leaves most of the weight to the background. One for the
    paper's filter."""
    redraw_share: float = 0.01
    """Share of the particles drawn anew from each frame's heat maps."""
    redraw_mass: float = 1e-3
    """Weight these get together: the probability that the track has been lost, in each frame."""


@dataclass(frozen=True)
class ParticleBelief:
    """Weighted points; the weights of each keypoint sum to one."""

    points_world: Float[ndarray, "k n 3"]
    weight: Float[ndarray, "k n"]
    held: Bool[ndarray, "k n"]
    """Whether a particle took part in the gripper's last motion."""


def particle_step(
    belief: ParticleBelief | None,
    observations: Sequence[Observation | None],
    motion: Motion | None = None,
    rng: Generator | None = None,
    settings: ParticleSettings = ParticleSettings(),
) -> tuple[ParticleBelief | None, Estimate]:
    """Belief and estimate after one more frame. Without a belief, particles are drawn from the heat maps.

    The estimate is that of the weighted particles, before resampling adds its noise. While no camera has measured any
    depth there is nothing to draw from: the belief stays None and the estimate NaN. A camera without a frame says
    nothing; without any, only time passes.

    Source: von Hartz et al. 2023, Sec. III-B, Eq. 2 and 10.
    """
    rng = np.random.default_rng(0) if rng is None else rng
    given = [seen for seen in observations if seen is not None]
    if belief is None:
        drawn = first_particles(given, rng, settings)
        if drawn is None:
            return None, nothing_known(len(observations), n_keypoints(observations))
        points, weight, likelihoods, log_prior = drawn
        held = np.zeros(weight.shape, dtype=bool)
    else:
        points, held = move(belief, motion, rng, settings)
        likelihoods = [likelihood(points, seen, settings) for seen in given]
        with np.errstate(divide="ignore"):
            log_weight = np.log(belief.weight)
        for total, _ in likelihoods:
            log_weight = log_weight + np.log(total)
        weight, log_prior = _normalised(log_weight)
    estimate = _estimate(points, weight, likelihoods, observations, log_prior)
    return refresh(ParticleBelief(points, weight, held), given, rng, settings), estimate


def move(
    belief: ParticleBelief, motion: Motion | None, rng: Generator, settings: ParticleSettings
) -> tuple[Float[ndarray, "k n 3"], Bool[ndarray, "k n"]]:
    """Particles after one frame, and which of them took part in the gripper's motion.

    x + m_r + m_w G_t, with G_t the gripper's rigid motion, rotation included. m_w is drawn anew in each frame with
    probability 1 - `gripper_memory`, and is else what it was: a Markov chain whose share of ones is p_w.

    Source: von Hartz et al. 2023, Eq. 4.
    """
    points_world = belief.points_world
    n = points_world.shape[1]
    walked = points_world + settings.walk * rng.standard_normal((n, 3))
    drawn_anew, takes_part = rng.random(n) >= settings.gripper_memory, rng.random(n) < settings.gripper_probability
    if motion is None:
        return walked, belief.held
    now_from_before = motion.world_from_gripper @ invert_rigid(motion.world_from_gripper_before)
    position = motion.world_from_gripper_before[:3, 3]
    near = np.linalg.norm(points_world - position, axis=-1) < settings.gripper_reach
    held = near & np.where(drawn_anew, takes_part, belief.held)
    if settings.gripper_turns:
        carried = transform(now_from_before, points_world) - points_world
    else:
        carried = np.broadcast_to(motion.world_from_gripper[:3, 3] - position, points_world.shape)
    return walked + carried * held[..., None], held


def likelihood(
    points_world: Float[ndarray, "k n 3"], seen: Observation, settings: ParticleSettings
) -> tuple[Float[ndarray, "k n"], Float[ndarray, "k n"]]:
    """Likelihood of a camera's frame given each particle, and the part of it that comes from the particle being seen.

        p = p_o p_f tau + (1 - p_f) tau + (1 - p_o) p_f p_d p_c

    p_o = 1 - Phi((z^d - (x^d - eps)) / sigma) is large where the *measured* depth z^d is clearly smaller than the
    particle's. p_d is exp(-(z^d - x^d)^2 / 2 sigma^2): its peak is one, so that tau weighs the same at every depth.

    A pixel without depth is a measurement of infinite noise, the limit of the formula for sigma to infinity: p_o = 1/2
    (hidden or not, nobody knows; `hidden_without_depth`) and p_d = 1. It says nothing of depth, and half of what it
    otherwise says of correspondence.

    Source: von Hartz et al. 2023, Eq. 6 to 10.
    """
    tau = unseen_likelihood(seen.distance, settings.alpha, settings.tau, settings.tau_ratio)
    height, width = seen.depth.shape
    rotation, position = seen.world_from_camera[:3, :3], seen.world_from_camera[:3, 3]
    uv, x_d = project((points_world - position) @ rotation, seen.K)
    inside = in_image(uv, height, width)
    i_keypoint, i_particle = np.nonzero(inside)
    uv, x_d = uv[inside], x_d[inside]
    nearest = np.rint(uv).astype(int).clip(0, [width - 1, height - 1])
    z_d = seen.depth[nearest[:, 1], nearest[:, 0]].astype(np.float64)
    measured = z_d > 0
    sigma = settings.depth_noise * x_d + settings.depth_noise_floor
    p_o = np.where(
        measured, 1.0 - ndtr((z_d - (x_d - settings.occlusion_margin)) / sigma), settings.hidden_without_depth
    )
    p_d = np.where(measured, np.exp(-0.5 * ((z_d - x_d) / sigma) ** 2), 1.0)
    p_c = np.exp(-settings.alpha * _sampled(seen, i_keypoint, uv))
    seen_part, total = np.zeros(inside.shape), np.tile(tau[:, None], inside.shape[1])
    seen_part[i_keypoint, i_particle] = (1 - p_o) * p_d * p_c
    total[i_keypoint, i_particle] = p_o * tau[i_keypoint]
    return np.maximum(total + seen_part, LEAST_LIKELIHOOD), seen_part


def _sampled(seen: Observation, i_keypoint: Int[ndarray, "m"], uv: Float[ndarray, "m 2"]) -> Float[ndarray, "m"]:
    """The distance maps, bilinear, at pixels of the depth image."""
    height, width = seen.distance.shape[1:]
    scale = np.array([width / seen.depth.shape[1], height / seen.depth.shape[0]])
    at = ((uv + 0.5) * scale - 0.5).clip(0, [width - 1, height - 1])
    corner = np.minimum(at.astype(int), [max(width - 2, 0), max(height - 2, 0)])
    a, b = (at - corner).T
    index = (i_keypoint * height + corner[:, 1]) * width + corner[:, 0]
    right, down = min(width - 1, 1), min(height - 1, 1) * width
    z = seen.distance.reshape(-1)
    upper = (1 - a) * z[index] + a * z[index + right]
    lower = (1 - a) * z[index + down] + a * z[index + down + right]
    return (1 - b) * upper + b * lower


def first_particles(
    observations: Sequence[Observation], rng: Generator, settings: ParticleSettings
) -> (
    tuple[
        Float[ndarray, "k n 3"],
        Float[ndarray, "k n"],
        list[tuple[Float[ndarray, "k n"], Float[ndarray, "k n"]]],
        Float[ndarray, "k"],
    ]
    | None
):
    """Particles drawn from the first heat maps, weights, likelihoods by camera, and log evidence; None without any
    depth.

    Each camera with depth gives an equal share. Its own frame is in what it drew; the other cameras weigh it.
    """
    usable = [i for i, seen in enumerate(observations) if (seen.depth > 0).any()]
    if not usable:
        return None
    owner = np.sort(np.resize(usable, settings.n_particles))
    points = np.concatenate([draw(observations[i], int((owner == i).sum()), rng, settings) for i in usable], axis=1)
    likelihoods = [likelihood(points, seen, settings) for seen in observations]
    log_weight = np.full(points.shape[:2], -np.log(settings.n_particles))
    for i, (total, _) in enumerate(likelihoods):
        log_weight = log_weight + np.where(owner == i, 0.0, np.log(total))
    weight, log_others = _normalised(log_weight)
    log_own = np.mean([softmax_map(observations[i].distance, settings.alpha)[1] for i in usable], axis=0)
    return points, weight, likelihoods, log_own + log_others


def draw(
    seen: Observation, n: int, rng: Generator, settings: ParticleSettings, block: int = 1
) -> Float[ndarray, "k n 3"]:
    """n points per keypoint on the measured surface, from the heat map, with the noise of a pixel and of depth.

    Args:
        block: look at one pixel only, a random one, of each block x block pixels.
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
    alpha = settings.draw_sharpness * settings.alpha
    total = np.cumsum(np.exp(-alpha * (z - z.min(axis=1, keepdims=True)), dtype=np.float64), axis=1)
    at = (np.arange(n) + rng.random(n)) / n
    chosen = np.stack([np.searchsorted(row, at * row[-1], side="right") for row in total]).clip(max=len(v) - 1)
    scale = np.array([seen.depth.shape[1] / width, seen.depth.shape[0] / height])
    cell = np.stack([u[chosen], v[chosen]], axis=-1) + rng.uniform(-0.5, 0.5, (n, 2))
    z_d = depth[v[chosen], u[chosen]].astype(np.float64)
    z_d = z_d + rng.standard_normal(n) * (settings.depth_noise * z_d + settings.depth_noise_floor)
    return transform(seen.world_from_camera, unproject((cell + 0.5) * scale - 0.5, z_d, seen.K))


def refresh(
    belief: ParticleBelief, observations: Sequence[Observation], rng: Generator, settings: ParticleSettings
) -> ParticleBelief:
    """Particles for the next frame: resampled where few of them matter, the lightest ones drawn anew from the heat
    maps.

    Source: von Hartz et al. 2023, Sec. III-B.5.
    """
    k, n = belief.weight.shape
    points, weight, held = belief.points_world.copy(), belief.weight.copy(), belief.held.copy()
    spread = rng.random((n,))
    if settings.resampling == "systematic":
        spread = np.full_like(spread, spread[0])
    few = 1.0 / np.einsum("kn,kn->k", weight, weight) < settings.resample_below * n
    for i in map(int, np.flatnonzero(few)):
        chosen = stratified(weight[i], spread)
        points[i], held[i], weight[i] = points[i][chosen], held[i][chosen], 1.0 / n
    n_new = round(settings.redraw_share * n)
    usable = [seen for seen in observations if (seen.depth > 0).any()]
    ties = 1.0 + 1e-6 * rng.random(n)
    if not n_new or not usable:
        return ParticleBelief(points, weight, held)
    parts = np.array_split(np.arange(n_new), len(usable))
    new = np.concatenate(
        [
            draw(seen, len(part), rng, settings, DRAW_BLOCK)
            for seen, part in zip(usable, parts, strict=True)
            if len(part)
        ],
        axis=1,
    )
    lightest = np.argpartition(weight * ties, n_new, axis=1)[:, :n_new]
    rows = np.arange(k)[:, None]
    points[rows, lightest] = new
    held[rows, lightest] = False
    weight[rows, lightest] = 0.0
    weight *= (1 - settings.redraw_mass) / weight.sum(axis=1, keepdims=True)
    weight[rows, lightest] = settings.redraw_mass / n_new
    return ParticleBelief(points, weight, held)


def stratified(weight: Float[ndarray, "m"], uniform: Float[ndarray, "n"]) -> Int[ndarray, "n"]:
    """Indices of n particles, one drawn from each n-th of the cumulated weight: i appears n weight[i] times in the
    mean. With the same random number n times over it is systematic resampling."""
    n = len(uniform)
    total = np.cumsum(weight)
    return np.searchsorted(total, (np.arange(n) + uniform) / n * total[-1], side="right").clip(max=len(weight) - 1)


def _normalised(log_weight: Float[ndarray, "k n"]) -> tuple[Float[ndarray, "k n"], Float[ndarray, "k"]]:
    """Weights that sum to one, and the log of the sum they had."""
    highest = log_weight.max(axis=1, keepdims=True)
    weight = np.exp(log_weight - highest)
    total = weight.sum(axis=1, keepdims=True)
    return weight / total, (np.log(total) + highest)[:, 0]


def _estimate(
    points: Float[ndarray, "k n 3"],
    weight: Float[ndarray, "k n"],
    likelihoods: Sequence[tuple[Float[ndarray, "k n"], Float[ndarray, "k n"]]],
    observations: Sequence[Observation | None],
    log_evidence: Float[ndarray, "k"],
) -> Estimate:
    mean = np.einsum("kn,kni->ki", weight, points)
    offset = points - mean[:, None]
    observed = np.zeros((len(observations), len(points)), dtype=bool)
    given = [i for i, seen in enumerate(observations) if seen is not None]
    for i, (total, part) in zip(given, likelihoods, strict=True):
        observed[i] = np.einsum("kn,kn->k", weight, part / total) > 0.5
    return Estimate(
        mean=mean,
        covariance=np.einsum("kn,kni,knj->kij", weight, offset, offset, optimize=True),
        mode=mode(points, weight),
        n_eff=1.0 / np.einsum("kn,kn->k", weight, weight),
        log_evidence=log_evidence,
        pixel=projections(mean, observations),
        observed=observed,
    )


def mode(
    points: Float[ndarray, "k n 3"], weight: Float[ndarray, "k n"], radius: float = MODE_RADIUS
) -> Float[ndarray, "k 3"]:
    """Mean of the ball of particles that holds the most weight, among balls around every so many-th of the weight.

    A histogram would be cheaper, but a cluster cut by its cells loses against a lighter one that is not.
    """
    k = len(points)
    offset = (points - np.einsum("kn,kni->ki", weight, points)[:, None]).astype(np.float32)
    some = np.stack([one[stratified(w, np.full(N_MODES, 0.5))] for one, w in zip(offset, weight, strict=True)])
    square = np.einsum("kni,kni->kn", offset, offset)[:, None] - 2 * some @ offset.transpose(0, 2, 1)
    near = square < np.float32(radius**2) - np.einsum("kci,kci->kc", some, some)[..., None]
    heaviest = (near @ weight.astype(np.float32)[..., None])[..., 0].argmax(axis=1)
    inside = near[np.arange(k), heaviest] * weight
    for _ in range(2):
        centre = np.einsum("kn,kni->ki", inside, points) / inside.sum(axis=1)[:, None]
        away = points - centre[:, None]
        shifted = (np.einsum("kni,kni->kn", away, away) < radius**2) * weight
        inside = np.where(shifted.sum(axis=1)[:, None] > 0, shifted, inside)
    return np.einsum("kn,kni->ki", inside, points) / inside.sum(axis=1)[:, None]
