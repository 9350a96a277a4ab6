"""The particle filter of `core.particle_filter` on tensors, with the same random numbers, drawn by NumPy."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int
from numpy.random import Generator
from torch import Tensor

from bask_data.core.heatmap import TAU_MOST, Motion
from bask_data.core.particle_filter import (
    DRAW_BLOCK,
    FOUND,
    LEAST_LIKELIHOOD,
    LOOKALIKE_BETTER,
    LOOKALIKE_RADIUS,
    MODE_RADIUS,
    N_MODES,
    UNFOUND_MASS,
    USUAL_RATE,
    ParticleBelief,
    ParticleSettings,
)
from bask_data.nn.filters.frames import (
    TensorEstimate,
    TensorObservation,
    n_keypoints,
    nothing_known,
    project,
    projections,
    transform,
    unproject,
    unseen_likelihood,
)


@dataclass(frozen=True)
class TensorParticleBelief:
    """A `ParticleBelief` on a device, field by field."""

    points_world: Float64[Tensor, "k n 3"]
    weight: Float64[Tensor, "k n"]
    held: Bool[Tensor, "k n"]
    lookalikes: Float64[Tensor, "k m 3"]
    lookalike_match: Float64[Tensor, "k m"]
    usual_match: Float64[Tensor, "k"]


@dataclass(frozen=True)
class _Look:
    likelihood: Float64[Tensor, "k n"]
    seen: Float64[Tensor, "k n"]
    tau: Float64[Tensor, "k"]


@dataclass(frozen=True)
class _Dice:
    """NumPy's random numbers on a device."""

    rng: Generator
    device: torch.device

    def normal(self, *shape: int) -> Float64[Tensor, "..."]:
        return torch.from_numpy(self.rng.standard_normal(shape)).to(self.device)

    def uniform(self, *shape: int) -> Float64[Tensor, "..."]:
        return torch.from_numpy(self.rng.random(shape)).to(self.device)

    def offsets(self, *shape: int) -> Float64[Tensor, "..."]:
        return torch.from_numpy(self.rng.uniform(-0.5, 0.5, shape)).to(self.device)

    def integers(self, below: int, *shape: int) -> Int[Tensor, "..."]:
        return torch.from_numpy(self.rng.integers(below, size=shape)).to(self.device)


def particle_belief_on(belief: ParticleBelief, device: torch.device | str = "cpu") -> TensorParticleBelief:
    """A belief on a device."""
    return TensorParticleBelief(
        **{one.name: torch.as_tensor(getattr(belief, one.name), device=device) for one in fields(belief)}
    )


def particle_belief_from(belief: TensorParticleBelief) -> ParticleBelief:
    """A belief back from its device."""
    return ParticleBelief(**{one.name: getattr(belief, one.name).cpu().numpy() for one in fields(belief)})


def particle_step(
    belief: TensorParticleBelief | None,
    observations: Sequence[TensorObservation | None],
    motion: Motion | None,
    rng: Generator,
    settings: ParticleSettings,
) -> tuple[TensorParticleBelief | None, TensorEstimate]:
    """Belief and estimate after one more frame: `core.particle_filter.particle_step` on tensors."""
    given = [seen for seen in observations if seen is not None]
    if belief is None:
        device = given[0].depth.device if given else torch.device("cpu")
        usable = [i for i, seen in enumerate(given) if bool((seen.depth > 0).any())]
        if not usable:
            return None, nothing_known(len(observations), n_keypoints(observations), device)
        belief, looks, log_evidence = _first_particles(given, usable, _Dice(rng, device), settings)
    else:
        belief = _moved(belief, motion, _Dice(rng, belief.weight.device), settings)
        looks = [_look(belief.points_world, seen, settings, belief.usual_match) for seen in given]
        log_weight = belief.weight.log()
        for one in looks:
            log_weight = log_weight + one.likelihood.log()
        weight, log_evidence = _normalised(log_weight)
        belief = replace(belief, weight=weight)
    estimate = _estimate(belief, looks, observations, log_evidence)
    return _refreshed(belief, estimate, looks, given, _Dice(rng, belief.weight.device), settings), estimate


def _moved(
    belief: TensorParticleBelief, motion: Motion | None, dice: _Dice, settings: ParticleSettings
) -> TensorParticleBelief:
    points = belief.points_world
    n = points.shape[1]
    walked = points + settings.walk * dice.normal(n, 3)
    drawn_anew, takes_part = dice.uniform(n) >= settings.gripper_memory, dice.uniform(n) < settings.gripper_probability
    if motion is None:
        return replace(belief, points_world=walked)
    before = torch.as_tensor(motion.world_from_gripper_before, device=dice.device).double()
    now = torch.as_tensor(motion.world_from_gripper, device=dice.device).double()
    near = (points - before[:3, 3]).norm(dim=-1) < settings.gripper_reach
    held = near & torch.where(drawn_anew, takes_part, belief.held)
    if settings.gripper_turns:
        rotation = now[:3, :3] @ before[:3, :3].T
        carried = points @ rotation.T + (now[:3, 3] - rotation @ before[:3, 3]) - points
    else:
        carried = (now[:3, 3] - before[:3, 3]).expand_as(points)
    return replace(belief, points_world=walked + carried * held[..., None], held=held)


def _look(
    points: Float64[Tensor, "k n 3"],
    seen: TensorObservation,
    settings: ParticleSettings,
    usual_match: Float64[Tensor, "k"] | None = None,
) -> _Look:
    tau = _tau(seen, settings, usual_match)
    height, width = seen.depth.shape
    points_camera = (points - seen.world_from_camera[:3, 3]) @ seen.world_from_camera[:3, :3]
    x_d, (u, v) = points_camera[..., 2], project(points_camera, seen.K).unbind(-1)
    # NaN behind the camera, which no comparison holds for.
    inside = (u >= -0.5) & (u < width - 0.5) & (v >= -0.5) & (v < height - 0.5)
    u, v, x_d = (torch.where(inside, one, torch.zeros_like(one)) for one in (u, v, x_d))
    z_d = seen.depth[v.round().long().clamp(0, height - 1), u.round().long().clamp(0, width - 1)]
    sigma = settings.depth_noise * x_d + settings.depth_noise_floor
    p_o = 0.5 * torch.erfc((z_d - (x_d - settings.occlusion_margin)) / sigma * math.sqrt(0.5))
    p_o = torch.where(z_d > 0, p_o, torch.full_like(p_o, settings.hidden_without_depth))
    p_d = torch.where(z_d > 0, (-0.5 * ((z_d - x_d) / sigma).square()).exp(), torch.ones_like(z_d))
    part = (1 - p_o) * p_d * (-settings.alpha * _sampled(seen.distance, u, v, (height, width))).exp()
    total = (p_o * tau[:, None] + part).clamp(min=LEAST_LIKELIHOOD)
    nothing = torch.zeros_like(part)
    return _Look(torch.where(inside, total, tau[:, None].expand_as(total)), torch.where(inside, part, nothing), tau)


def _tau(
    seen: TensorObservation, settings: ParticleSettings, usual_match: Float64[Tensor, "k"] | None
) -> Float64[Tensor, "k"]:
    tau = unseen_likelihood(seen.distance, settings.alpha, settings.tau, settings.tau_ratio)
    if usual_match is None or settings.tau is not None:
        return tau
    return torch.maximum(tau, (settings.tau_match * usual_match).clamp(max=TAU_MOST))


def _sampled(
    maps: Float[Tensor, "k hz wz"], u: Float64[Tensor, "k n"], v: Float64[Tensor, "k n"], size: tuple[int, int]
) -> Float64[Tensor, "k n"]:
    """The distance maps, bilinear, at pixels of an image of `size`."""
    k, height, width = maps.shape
    at_u = ((u + 0.5) * (width / size[1]) - 0.5).clamp(0, width - 1)
    at_v = ((v + 0.5) * (height / size[0]) - 0.5).clamp(0, height - 1)
    left, top = at_u.long().clamp(max=max(width - 2, 0)), at_v.long().clamp(max=max(height - 2, 0))
    a, b = at_u - left, at_v - top
    right, down = min(width - 1, 1), min(height - 1, 1)
    i = torch.arange(k, device=maps.device)[:, None]
    upper = (1 - a) * maps[i, top, left] + a * maps[i, top, left + right]
    lower = (1 - a) * maps[i, top + down, left] + a * maps[i, top + down, left + right]
    return (1 - b) * upper + b * lower


def _first_particles(
    observations: Sequence[TensorObservation], usable: Sequence[int], dice: _Dice, settings: ParticleSettings
) -> tuple[TensorParticleBelief, list[_Look], Float64[Tensor, "k"]]:
    n, m = settings.n_particles, settings.n_lookalikes
    owner = torch.from_numpy(np.sort(np.resize(usable, n))).to(dice.device)
    points = torch.cat([_drawn(observations[i], int((owner == i).sum()), dice, settings)[0] for i in usable], dim=1)
    looks = [_look(points, seen, settings) for seen in observations]
    log_weight = torch.full_like(points[..., 0], -math.log(n))
    for i, one in enumerate(looks):
        log_weight = log_weight + torch.where(owner == i, torch.zeros_like(log_weight), one.likelihood.log())
    weight, log_others = _normalised(log_weight)
    own = [(-settings.alpha * observations[i].distance.double()).flatten(1) for i in usable]
    log_own = torch.stack([one.logsumexp(dim=1) - math.log(one.shape[1]) for one in own]).mean(dim=0)
    k, none = len(points), torch.zeros_like(weight)
    belief = TensorParticleBelief(
        points_world=points,
        weight=weight,
        held=none > 0,
        lookalikes=none.new_full((k, m, 3), math.nan),
        lookalike_match=none.new_zeros((k, m)),
        usual_match=none.new_zeros(k),
    )
    return belief, looks, log_own + log_others


def _drawn(
    seen: TensorObservation, n: int, dice: _Dice, settings: ParticleSettings, block: int = 1
) -> tuple[Float64[Tensor, "k n 3"], Float64[Tensor, "k n"]]:
    """Points from the heat map, and how each matches."""
    height, width = seen.map_depth.shape
    grid = (torch.arange(0, height, block, device=dice.device), torch.arange(0, width, block, device=dice.device))
    v, u = torch.meshgrid(*grid, indexing="ij")
    if block > 1:
        v = (v + dice.integers(block, *v.shape)).clamp(max=height - 1)
        u = (u + dice.integers(block, *u.shape)).clamp(max=width - 1)
    measured = seen.map_depth[v, u] > 0
    v, u = (v[measured], u[measured]) if bool(measured.any()) else (seen.map_depth > 0).nonzero(as_tuple=True)
    z = seen.distance[:, v, u]
    alpha = settings.draw_sharpness * settings.alpha
    total = (-alpha * (z - z.amin(dim=1, keepdim=True))).double().exp().cumsum(dim=1)
    at = (torch.arange(n, device=dice.device) + dice.uniform(n)) / n
    chosen = torch.searchsorted(total, at * total[:, -1:], right=True).clamp(max=len(v) - 1)
    cell = torch.stack([u[chosen], v[chosen]], dim=-1) + dice.offsets(n, 2)
    z_d = seen.map_depth[v[chosen], u[chosen]]
    z_d = z_d + dice.normal(n) * (settings.depth_noise * z_d + settings.depth_noise_floor)
    scale = z_d.new_tensor([seen.depth.shape[1] / width, seen.depth.shape[0] / height])
    points = transform(seen.world_from_camera, unproject((cell + 0.5) * scale - 0.5, z_d, seen.K))
    return points, (-settings.alpha * z.gather(1, chosen)).double().exp()


def _refreshed(
    belief: TensorParticleBelief,
    estimate: TensorEstimate,
    looks: Sequence[_Look],
    observations: Sequence[TensorObservation],
    dice: _Dice,
    settings: ParticleSettings,
) -> TensorParticleBelief:
    k, n = belief.weight.shape
    spread = dice.uniform(n)
    if settings.resampling == "systematic":
        spread = spread[:1].expand(n)
    matched, tau = _matched_now(belief, looks)
    rate = torch.where(belief.usual_match > 0, USUAL_RATE, 1.0) * (matched > FOUND * tau)
    usual_match = belief.usual_match + rate * (matched - belief.usual_match)
    belief = replace(_resampled(belief, spread, settings), usual_match=usual_match)
    n_new = round(settings.redraw_share * n)
    usable = [seen for seen in observations if bool((seen.depth > 0).any())]
    ties = 1.0 + 1e-6 * dice.uniform(n)
    if not n_new or not usable:
        return belief
    parts = [len(part) for part in np.array_split(np.arange(n_new), len(usable))]
    drawn = [_drawn(seen, here, dice, settings, DRAW_BLOCK) for seen, here in zip(usable, parts, strict=True) if here]
    new, match = (torch.cat(values, dim=1) for values in zip(*drawn, strict=True))
    share, is_new = torch.full_like(matched, settings.redraw_mass), torch.ones_like(match, dtype=torch.bool)
    if settings.n_lookalikes:
        share = share * torch.where(belief.usual_match > 0, 1.0 - matched, UNFOUND_MASS)
        apart = (new[:, :, None] - belief.lookalikes[:, None]).norm(dim=-1)
        same = (apart < LOOKALIKE_RADIUS) & (match[:, :, None] < LOOKALIKE_BETTER * belief.lookalike_match[:, None])
        is_new = ~same.any(dim=-1)
        belief = _with_lookalikes(belief, estimate, matched, new, match)
    lightest = ((belief.weight + 1e-300) * ties).topk(n_new, dim=1, largest=False).indices.sort(dim=1).values
    at = torch.arange(k, device=dice.device)[:, None], lightest
    points, weight, held = belief.points_world.clone(), belief.weight.clone(), belief.held.clone()
    points[at], held[at], weight[at] = new, torch.zeros_like(is_new), torch.zeros_like(match)
    weight /= weight.sum(dim=1, keepdim=True)
    weight[at] = is_new * share[:, None] / n_new
    return replace(belief, points_world=points, weight=weight / weight.sum(dim=1, keepdim=True), held=held)


def _matched_now(
    belief: TensorParticleBelief, looks: Sequence[_Look]
) -> tuple[Float64[Tensor, "k"], Float64[Tensor, "k"]]:
    if not looks:
        return torch.zeros_like(belief.usual_match), torch.ones_like(belief.usual_match)
    matched, best = torch.stack([(belief.weight * one.seen).sum(dim=1) for one in looks]).max(dim=0)
    return matched.clamp(max=1.0), torch.stack([one.tau for one in looks]).gather(0, best[None])[0]


def _with_lookalikes(
    belief: TensorParticleBelief,
    estimate: TensorEstimate,
    matched: Float64[Tensor, "k"],
    points: Float64[Tensor, "k n 3"],
    match: Float64[Tensor, "k n"],
) -> TensorParticleBelief:
    spread = estimate.covariance.diagonal(dim1=1, dim2=2).sum(dim=1).sqrt()
    sure = (belief.usual_match > 0) & (spread < 0.5 * LOOKALIKE_RADIUS)
    far = (points - estimate.mean[:, None]).norm(dim=-1) > LOOKALIKE_RADIUS
    other = sure[:, None] & far & (match < LOOKALIKE_BETTER * matched[:, None])
    # What is new goes first and pushes out what is oldest, each in its order.
    all_points, all_match = torch.cat([points, belief.lookalikes], 1), torch.cat([match, belief.lookalike_match], 1)
    kept = torch.cat([other, torch.ones_like(belief.lookalike_match, dtype=torch.bool)], dim=1)
    order = (~kept).to(torch.uint8).argsort(dim=1, stable=True)[:, : belief.lookalikes.shape[1]]
    return replace(
        belief,
        lookalikes=all_points.gather(1, order[..., None].expand(-1, -1, 3)),
        lookalike_match=all_match.gather(1, order),
    )


def _resampled(
    belief: TensorParticleBelief, spread: Float64[Tensor, "n"], settings: ParticleSettings
) -> TensorParticleBelief:
    k, n = belief.weight.shape
    few = 1.0 / belief.weight.square().sum(dim=1) < settings.resample_below * n
    chosen = torch.where(few[:, None], _stratified(belief.weight, spread), torch.arange(n, device=belief.weight.device))
    at = torch.arange(k, device=belief.weight.device)[:, None], chosen
    weight = torch.where(few[:, None], 1.0 / n, belief.weight)
    return replace(belief, points_world=belief.points_world[at], weight=weight, held=belief.held[at])


def _stratified(weight: Float64[Tensor, "k m"], uniform: Float64[Tensor, "n"]) -> Int[Tensor, "k n"]:
    total = weight.cumsum(dim=1)
    n = len(uniform)
    at = (torch.arange(n, device=weight.device) + uniform) / n * total[:, -1:]
    return torch.searchsorted(total, at, right=True).clamp(max=weight.shape[1] - 1)


def _normalised(log_weight: Float64[Tensor, "k n"]) -> tuple[Float64[Tensor, "k n"], Float64[Tensor, "k"]]:
    total = log_weight.logsumexp(dim=1)
    return (log_weight - total[:, None]).exp(), total


def _estimate(
    belief: TensorParticleBelief,
    looks: Sequence[_Look],
    observations: Sequence[TensorObservation | None],
    log_evidence: Float64[Tensor, "k"],
) -> TensorEstimate:
    points, weight = belief.points_world, belief.weight
    mean = torch.einsum("kn,kni->ki", weight, points)
    offset = points - mean[:, None]
    observed = torch.zeros((len(observations), len(points)), dtype=torch.bool, device=points.device)
    given = [i for i, seen in enumerate(observations) if seen is not None]
    for i, one in zip(given, looks, strict=True):
        observed[i] = (weight * one.seen / one.likelihood).sum(dim=1) > 0.5
    return TensorEstimate(
        mean=mean,
        covariance=torch.einsum("kn,kni,knj->kij", weight, offset, offset),
        mode=_mode(points, weight),
        n_eff=1.0 / weight.square().sum(dim=1),
        log_evidence=log_evidence,
        pixel=projections(mean, observations),
        observed=observed,
    )


def _mode(points: Float64[Tensor, "k n 3"], weight: Float64[Tensor, "k n"]) -> Float64[Tensor, "k 3"]:
    i = torch.arange(len(points), device=points.device)
    some = points[i[:, None], _stratified(weight, weight.new_full((N_MODES,), 0.5))]
    near = (some[:, :, None] - points[:, None]).square().sum(dim=-1) < MODE_RADIUS**2
    centre = some[i, (near * weight[:, None]).sum(dim=-1).argmax(dim=1)]
    for _ in range(3):
        inside = ((points - centre[:, None]).square().sum(dim=-1) < MODE_RADIUS**2) * weight
        total = inside.sum(dim=1)[:, None]
        centre = torch.where(total > 0, torch.einsum("kn,kni->ki", inside, points) / total.clamp(min=1e-300), centre)
    return centre
