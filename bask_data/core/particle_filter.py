"""The particle filter: for each keypoint weighted points in the world frame, seen by any number of cameras, or by none.

All keypoints share one stream of random numbers, drawn once per particle and not once per keypoint. A keypoint's track
therefore does not depend on which others are tracked beside it, and drawing costs the same for one as for sixteen.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from numpy.random import Generator

from bask_data.core.compiled import compiled
from bask_data.core.geometry import invert_rigid, transform, unproject
from bask_data.core.heatmap import (
    TAU_MOST,
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

LOOKALIKE_RADIUS = 0.06
"""Metres around a look-alike, or around the track, that count as the same place. A track must be twice as sure to tell
the one from the other."""

LOOKALIKE_BETTER = 1.5
"""What matches better than a look-alike by this factor is another thing that came to its place."""

FOUND = 2.0
"""A track is found where a camera sees it match this many times better than tau."""

USUAL_RATE = 0.1
"""How fast the usual match follows that of a frame."""

UNFOUND_MASS = 20.0
"""How much more weight is drawn anew until then."""

N_MODES = 32
"""Number of particles whose surroundings are weighed in search of the mode."""


@dataclass(frozen=True)
class ParticleSettings:
    """Settings of the particle filter."""

    n_particles: int = 2000
    alpha: float = 2.0
    """Temperature: a pixel at distance z has correspondence likelihood exp(-alpha z). Half of what networks are trained
    with, and the paper's: frames of one motion err together, and what they say must not count in full each time."""
    tau: float | None = None
    """Likelihood of any observation if the camera does not see the particle; None: `unseen_likelihood` says it of each
    frame."""
    tau_ratio: float = 2.0
    """Without `tau`: how much likelier the keypoint is out of sight than at the average pixel ..."""
    tau_match: float = 0.03
    """... and at least: this share of how well the track has matched, on average, while seen. The best match of an
    image that does not show the keypoint is far above the average pixel."""
    walk: float = 0.002
    """Standard deviation of the random walk in one frame and along each axis, metres."""
    gripper_probability: float = 0.2
    """Probability that a particle near the gripper takes part in the gripper's motion."""
    gripper_memory: float = 0.9
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
    draw_sharpness: float = 6.0
    """How much higher than alpha the temperature is of the heat maps that particles are drawn from, first and later:
    alpha is made for many frames together, and in a single one leaves most of the weight to the background. One for the
    paper's filter."""
    redraw_share: float = 0.01
    """Share of the particles drawn anew from each frame's heat maps."""
    redraw_mass: float = 1e-3
    """Weight these get together where the track is not seen to match: the probability that it has been lost, in each
    frame."""
    n_lookalikes: int = 64
    """How many places to remember that matched while the keypoint was seen elsewhere: none of them is it. Zero for the
    paper's filter: whatever looks alike takes the keypoint over, then, once that is out of sight."""


@dataclass(frozen=True)
class ParticleBelief:
    """Weighted points; the weights of each keypoint sum to one."""

    points_world: Float[ndarray, "k n 3"]
    weight: Float[ndarray, "k n"]
    held: Bool[ndarray, "k n"]
    """Whether a particle took part in the gripper's last motion."""
    lookalikes: Float[ndarray, "k m 3"]
    """Places that are not the keypoint, however they match, the last found first; NaN where there are not so many."""
    lookalike_match: Float[ndarray, "k m"]
    """exp(-alpha z) of each."""
    usual_match: Float[ndarray, "k"]
    """p_d p_c of the track on average, of late, while it was seen; 0 where it never was."""


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
        belief, looks, log_evidence = drawn
    else:
        belief = move(belief, motion, rng, settings)
        looks = [look(belief.points_world, seen, settings, belief.usual_match) for seen in given]
        with np.errstate(divide="ignore"):
            log_weight = np.log(belief.weight)
        for one in looks:
            log_weight = log_weight + np.log(one.likelihood)
        weight, log_evidence = _normalised(log_weight)
        belief = replace(belief, weight=weight)
    estimate = _estimate(belief, looks, observations, log_evidence)
    return refresh(belief, estimate, looks, given, rng, settings), estimate


def move(belief: ParticleBelief, motion: Motion | None, rng: Generator, settings: ParticleSettings) -> ParticleBelief:
    """The belief after one frame, before anything is seen of it.

    x + m_r + m_w G_t, with G_t the gripper's rigid motion, rotation included. m_w is drawn anew in each frame with
    probability 1 - `gripper_memory`, and is else what it was: a Markov chain whose share of ones is p_w.

    Source: von Hartz et al. 2023, Eq. 4.
    """
    points_world = belief.points_world
    n = points_world.shape[1]
    walked = points_world + settings.walk * rng.standard_normal((n, 3))
    drawn_anew, takes_part = rng.random(n) >= settings.gripper_memory, rng.random(n) < settings.gripper_probability
    if motion is None:
        return replace(belief, points_world=walked)
    now_from_before = motion.world_from_gripper @ invert_rigid(motion.world_from_gripper_before)
    position = motion.world_from_gripper_before[:3, 3]
    near = np.linalg.norm(points_world - position, axis=-1) < settings.gripper_reach
    held = near & np.where(drawn_anew, takes_part, belief.held)
    if settings.gripper_turns:
        carried = transform(now_from_before, points_world) - points_world
    else:
        carried = np.broadcast_to(motion.world_from_gripper[:3, 3] - position, points_world.shape)
    return replace(belief, points_world=walked + carried * held[..., None], held=held)


@dataclass(frozen=True)
class Look:
    """What one camera's frame says of each particle.

    Attributes:
        likelihood: of the frame given the particle.
        seen: the part of it that comes from the particle being seen.
        tau: of the frame if the camera does not see the keypoint.
    """

    likelihood: Float[ndarray, "k n"]
    seen: Float[ndarray, "k n"]
    tau: Float[ndarray, "k"]


def look(
    points_world: Float[ndarray, "k n 3"],
    seen: Observation,
    settings: ParticleSettings,
    usual_match: Float[ndarray, "k"] | float = 0.0,
) -> Look:
    """Particles in a camera's frame.

        p = p_o p_f tau + (1 - p_f) tau + (1 - p_o) p_f p_d p_c

    p_o = 1 - Phi((z^d - (x^d - eps)) / sigma) is large where the *measured* depth z^d is clearly smaller than the
    particle's. p_d is exp(-(z^d - x^d)^2 / 2 sigma^2): its peak is one, so that tau weighs the same at every depth.

    A pixel without depth is a measurement of infinite noise, the limit of the formula for sigma to infinity: p_o = 1/2
    (hidden or not, nobody knows; `hidden_without_depth`) and p_d = 1. It says nothing of depth, and half of what it
    otherwise says of correspondence.

    Source: von Hartz et al. 2023, Eq. 6 to 10.
    """
    tau = unseen_likelihood(seen.distance, settings.alpha, settings.tau, settings.tau_ratio)
    if settings.tau is None:
        tau = np.maximum(tau, np.minimum(settings.tau_match * usual_match, TAU_MOST))
    rotation, position = seen.world_from_camera[:3, :3], seen.world_from_camera[:3, 3]
    noise = (settings.depth_noise, settings.depth_noise_floor, settings.occlusion_margin, settings.hidden_without_depth)
    total, part = np.empty(points_world.shape[:2]), np.empty(points_world.shape[:2])
    _look(
        points_world,
        seen.distance,
        seen.depth,
        rotation,
        position,
        seen.K,
        settings.alpha,
        tau,
        np.array(noise),
        total,
        part,
    )
    return Look(total, part, tau)


@compiled
def _look(
    points_world: ndarray,
    distance: ndarray,
    depth: ndarray,
    rotation: ndarray,
    position: ndarray,
    K: ndarray,
    alpha: float,
    tau: ndarray,
    noise: ndarray,
    total: ndarray,
    part: ndarray,
) -> None:
    """Fills `total` and `part`. A particle's depth is that of the nearest pixel, its distance bilinear."""
    height, width = depth.shape
    map_height, map_width = distance.shape[1:]
    share, floor, margin, hidden = noise
    scale_u, scale_v = map_width / width, map_height / height
    right, down = min(map_width - 1, 1), min(map_height - 1, 1)
    for i in range(points_world.shape[0]):
        for j in range(points_world.shape[1]):
            total[i, j], part[i, j] = tau[i], 0.0
            a = points_world[i, j, 0] - position[0]
            b = points_world[i, j, 1] - position[1]
            c = points_world[i, j, 2] - position[2]
            x_d = a * rotation[0, 2] + b * rotation[1, 2] + c * rotation[2, 2]
            if not x_d > 0:
                continue
            x = (a * rotation[0, 0] + b * rotation[1, 0] + c * rotation[2, 0]) / x_d
            y = (a * rotation[0, 1] + b * rotation[1, 1] + c * rotation[2, 1]) / x_d
            u = K[0, 0] * x + K[0, 1] * y + K[0, 2]
            v = K[1, 1] * y + K[1, 2]
            if not (-0.5 <= u < width - 0.5 and -0.5 <= v < height - 0.5):
                continue
            z_d = depth[min(max(int(np.rint(v)), 0), height - 1), min(max(int(np.rint(u)), 0), width - 1)]
            p_o, p_d = hidden, 1.0
            if z_d > 0:
                sigma = share * x_d + floor
                p_o = 0.5 * math.erfc((z_d - (x_d - margin)) / sigma * math.sqrt(0.5))
                p_d = math.exp(-0.5 * ((z_d - x_d) / sigma) ** 2)
            map_u = min(max((u + 0.5) * scale_u - 0.5, 0.0), map_width - 1.0)
            map_v = min(max((v + 0.5) * scale_v - 0.5, 0.0), map_height - 1.0)
            left, top = min(int(map_u), max(map_width - 2, 0)), min(int(map_v), max(map_height - 2, 0))
            s, t = map_u - left, map_v - top
            upper = (1 - s) * distance[i, top, left] + s * distance[i, top, left + right]
            lower = (1 - s) * distance[i, top + down, left] + s * distance[i, top + down, left + right]
            part[i, j] = (1.0 - p_o) * p_d * math.exp(-alpha * ((1 - t) * upper + t * lower))
            total[i, j] = max(p_o * tau[i] + part[i, j], LEAST_LIKELIHOOD)


def first_particles(
    observations: Sequence[Observation], rng: Generator, settings: ParticleSettings
) -> tuple[ParticleBelief, list[Look], Float[ndarray, "k"]] | None:
    """Particles drawn from the first heat maps, what cameras say of them, and log evidence; None without any depth.

    Each camera with depth gives an equal share. Its own frame is in what it drew; the other cameras weigh it.
    """
    usable = [i for i, seen in enumerate(observations) if (seen.depth > 0).any()]
    if not usable:
        return None
    n = settings.n_particles
    owner = np.sort(np.resize(usable, n))
    drawn = [draw(observations[i], int((owner == i).sum()), rng, settings) for i in usable]
    points = np.concatenate([one.points_world for one in drawn], axis=1)
    looks = [look(points, seen, settings) for seen in observations]
    log_weight = np.full(points.shape[:2], -np.log(n))
    for i, one in enumerate(looks):
        log_weight = log_weight + np.where(owner == i, 0.0, np.log(one.likelihood))
    weight, log_others = _normalised(log_weight)
    log_own = np.mean([softmax_map(observations[i].distance, settings.alpha)[1] for i in usable], axis=0)
    return new_belief(points, weight, settings.n_lookalikes), looks, log_own + log_others


def new_belief(
    points_world: Float[ndarray, "k n 3"], weight: Float[ndarray, "k n"], n_lookalikes: int = 0
) -> ParticleBelief:
    """Particles that nothing holds, and no place that looks alike yet."""
    k = len(points_world)
    nowhere = np.full((k, n_lookalikes, 3), np.nan)
    held = np.zeros(weight.shape, dtype=bool)
    return ParticleBelief(points_world, weight, held, nowhere, np.zeros((k, n_lookalikes)), np.zeros(k))


@dataclass(frozen=True)
class Drawn:
    """Points drawn from a heat map, and exp(-alpha z) at each."""

    points_world: Float[ndarray, "k n 3"]
    match: Float[ndarray, "k n"]


def draw(seen: Observation, n: int, rng: Generator, settings: ParticleSettings, block: int = 1) -> Drawn:
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
    points = transform(seen.world_from_camera, unproject((cell + 0.5) * scale - 0.5, z_d, seen.K))
    return Drawn(points, np.exp(-settings.alpha * np.take_along_axis(z, chosen, axis=1), dtype=np.float64))


def refresh(
    belief: ParticleBelief,
    estimate: Estimate,
    looks: Sequence[Look],
    observations: Sequence[Observation],
    rng: Generator,
    settings: ParticleSettings,
) -> ParticleBelief:
    """The belief for the next frame: resampled where few particles matter, the lightest ones drawn anew from the heat
    maps.

    Where the track is seen, what is drawn far from it looks alike and is remembered; what is drawn near such a place is
    given no weight. Frames are not independent: a look-alike that stays in view would soon outweigh any place that is
    not, however small the weight it began with.

    Source: von Hartz et al. 2023, Sec. III-B.5.
    """
    k, n = belief.weight.shape
    spread = rng.random((n,))
    if settings.resampling == "systematic":
        spread = np.full_like(spread, spread[0])
    matched, tau = matched_now(belief, looks)
    belief = replace(_resampled(belief, spread, settings), usual_match=_usual_match(belief, matched, tau))
    n_new = round(settings.redraw_share * n)
    usable = [seen for seen in observations if (seen.depth > 0).any()]
    ties = 1.0 + 1e-6 * rng.random(n)  # Equal weights would leave the choice to how a sort goes about it.
    if not n_new or not usable:
        return belief
    parts = [len(part) for part in np.array_split(np.arange(n_new), len(usable))]
    drawn = [
        draw(seen, n_here, rng, settings, DRAW_BLOCK) for seen, n_here in zip(usable, parts, strict=True) if n_here
    ]
    new = np.concatenate([one.points_world for one in drawn], axis=1)
    match = np.concatenate([one.match for one in drawn], axis=1)
    share, is_new = np.full(k, settings.redraw_mass), np.ones(match.shape, dtype=bool)
    if settings.n_lookalikes:
        share *= np.where(belief.usual_match > 0, 1.0 - matched, UNFOUND_MASS)
        is_new = ~known_lookalikes(belief, new, match)
        belief = _with_lookalikes(belief, estimate, matched, new, match)
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


def matched_now(belief: ParticleBelief, looks: Sequence[Look]) -> tuple[Float[ndarray, "k"], Float[ndarray, "k"]]:
    """How well the track matches, at most one, in the camera that sees it best; and that camera's tau."""
    if not looks:
        return np.zeros(len(belief.weight)), np.ones(len(belief.weight))
    matched = np.stack([np.einsum("kn,kn->k", belief.weight, one.seen) for one in looks])
    best = matched.argmax(axis=0), np.arange(matched.shape[1])
    return np.minimum(matched[best], 1.0), np.stack([one.tau for one in looks])[best]


def _usual_match(belief: ParticleBelief, matched: Float[ndarray, "k"], tau: Float[ndarray, "k"]) -> Float[ndarray, "k"]:
    """The usual match after a frame in which the track matched like this."""
    rate = np.where(belief.usual_match > 0, USUAL_RATE, 1.0)
    return belief.usual_match + np.where(matched > FOUND * tau, rate, 0.0) * (matched - belief.usual_match)


def known_lookalikes(
    belief: ParticleBelief, points_world: Float[ndarray, "k n 3"], match: Float[ndarray, "k n"]
) -> Bool[ndarray, "k n"]:
    """Which points are where something looks alike, and match no better than that did."""
    apart = np.linalg.norm(points_world[:, :, None] - belief.lookalikes[:, None], axis=-1)
    same = (apart < LOOKALIKE_RADIUS) & (match[:, :, None] < LOOKALIKE_BETTER * belief.lookalike_match[:, None])
    return same.any(axis=-1)


def _with_lookalikes(
    belief: ParticleBelief,
    estimate: Estimate,
    matched: Float[ndarray, "k"],
    points_world: Float[ndarray, "k n 3"],
    match: Float[ndarray, "k n"],
) -> ParticleBelief:
    """The belief with what was drawn far from tracks that are seen and sure, and match as well."""
    spread = np.sqrt(np.trace(estimate.covariance, axis1=1, axis2=2))
    sure = (belief.usual_match > 0) & (spread < 0.5 * LOOKALIKE_RADIUS)
    far = np.linalg.norm(points_world - estimate.mean[:, None], axis=-1) > LOOKALIKE_RADIUS
    other = sure[:, None] & far & (match < LOOKALIKE_BETTER * matched[:, None])
    m = belief.lookalikes.shape[1]
    places, values = belief.lookalikes.copy(), belief.lookalike_match.copy()
    for i in map(int, np.flatnonzero(other.any(axis=1))):
        places[i] = np.concatenate([points_world[i, other[i]], places[i]])[:m]
        values[i] = np.concatenate([match[i, other[i]], values[i]])[:m]
    return replace(belief, lookalikes=places, lookalike_match=values)


def _resampled(belief: ParticleBelief, spread: Float[ndarray, "n"], settings: ParticleSettings) -> ParticleBelief:
    """Particles of equal weight where only few matter, else as they are."""
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
    belief: ParticleBelief,
    looks: Sequence[Look],
    observations: Sequence[Observation | None],
    log_evidence: Float[ndarray, "k"],
) -> Estimate:
    points, weight = belief.points_world, belief.weight
    mean = np.einsum("kn,kni->ki", weight, points)
    offset = points - mean[:, None]
    observed = np.zeros((len(observations), len(points)), dtype=bool)
    given = [i for i, seen in enumerate(observations) if seen is not None]
    for i, one in zip(given, looks, strict=True):
        observed[i] = np.einsum("kn,kn->k", weight, one.seen / one.likelihood) > 0.5
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
    some = np.stack([one[stratified(w, np.full(N_MODES, 0.5))] for one, w in zip(points, weight, strict=True)])
    centre = some[np.arange(len(points)), _mass_around(some, points, weight, radius).argmax(axis=1)]
    for _ in range(3):
        away = points - centre[:, None]
        inside = (np.einsum("kni,kni->kn", away, away) < radius**2) * weight
        total = inside.sum(axis=1)[:, None]
        centre = np.where(total > 0, np.einsum("kn,kni->ki", inside, points) / np.where(total > 0, total, 1.0), centre)
    return centre


@compiled
def _mass_around(some: ndarray, points: ndarray, weight: ndarray, radius: float) -> ndarray:
    """Weight of the points around each of some of them."""
    mass = np.zeros(some.shape[:2])
    for k in range(some.shape[0]):
        for c in range(some.shape[1]):
            x, y, z = some[k, c, 0], some[k, c, 1], some[k, c, 2]
            for n in range(points.shape[1]):
                a, b, d = points[k, n, 0] - x, points[k, n, 1] - y, points[k, n, 2] - z
                if a * a + b * b + d * d < radius * radius:
                    mass[k, c] += weight[k, n]
    return mass
