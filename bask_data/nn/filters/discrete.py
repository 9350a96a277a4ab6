"""The discrete filter of `core.discrete_filter` on tensors: no random numbers, the same to rounding."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from bask_data.core.discrete_filter import (
    FAR,
    LEAST_EVIDENCE,
    CameraBelief,
    DiscreteBelief,
    DiscreteSettings,
    motion_since,
)
from bask_data.core.geometry import invert_rigid
from bask_data.core.heatmap import Motion, fill_depth
from bask_data.nn.filters.frames import (
    TensorEstimate,
    TensorObservation,
    estimate_from,
    estimate_on,
    n_keypoints,
    project,
    transform,
    unproject,
    unseen_likelihood,
)
from bask_data.nn.filters.heatmap import TensorLifted, View, fuse, keep_last, lift, view_of


@dataclass(frozen=True)
class TensorCameraBelief:
    """A `CameraBelief` on a device."""

    inside: Float64[Tensor, "k h w"]
    outside: Float64[Tensor, "k"]
    view: View
    cell: Float64[Tensor, "2"]
    world_from_gripper: np.ndarray | None = None


@dataclass(frozen=True)
class TensorDiscreteBelief:
    """A `DiscreteBelief` on a device."""

    cameras: tuple[TensorCameraBelief | None, ...]
    estimate: TensorEstimate


def discrete_belief_on(belief: DiscreteBelief, device: torch.device | str = "cpu") -> TensorDiscreteBelief:
    """A belief on a device."""
    cameras: list[TensorCameraBelief | None] = []
    for one in belief.cameras:
        if one is None:
            cameras.append(None)
            continue
        view = (one.depth, fill_depth(one.depth), one.K, one.world_from_camera)
        inside, outside, cell, *seen = (
            torch.as_tensor(value, device=device).double() for value in (one.inside, one.outside, one.cell, *view)
        )
        cameras.append(TensorCameraBelief(inside, outside, View(*seen), cell, one.world_from_gripper))
    return TensorDiscreteBelief(tuple(cameras), estimate_on(belief.estimate, device))


def discrete_belief_from(belief: TensorDiscreteBelief) -> DiscreteBelief:
    """A belief back from its device."""
    cameras: list[CameraBelief | None] = []
    for one in belief.cameras:
        if one is None:
            cameras.append(None)
            continue
        values = (one.inside, one.outside, one.view.depth, one.view.K, one.view.world_from_camera, one.cell)
        back = CameraBelief(*(value.cpu().numpy() for value in values))
        cameras.append(replace(back, world_from_gripper=one.world_from_gripper))
    return DiscreteBelief(tuple(cameras), estimate_from(belief.estimate))


def discrete_step(
    belief: TensorDiscreteBelief | None,
    observations: Sequence[TensorObservation | None],
    motion: Motion | None,
    settings: DiscreteSettings,
) -> tuple[TensorDiscreteBelief, TensorEstimate]:
    """Belief and estimate after one more frame: `core.discrete_filter.discrete_step` on tensors."""
    known = belief.cameras if belief else ()
    before = (*known, *[None] * (len(observations) - len(known)))
    filtered = [_camera_step(one, seen, motion, settings) for one, seen in zip(before, observations, strict=True)]
    k = len(belief.estimate.mean) if belief else n_keypoints(observations)
    now = fuse([lifted for _, lifted in filtered], k)
    given = torch.tensor([seen is not None for seen in observations], device=now.mean.device)
    now = replace(
        now, pixel=torch.where(given[:, None, None], now.pixel, math.nan), observed=now.observed & given[:, None]
    )
    estimate = keep_last(now, belief.estimate if belief else None, observations)
    return TensorDiscreteBelief(tuple(one for one, _ in filtered), estimate), estimate


def _camera_step(
    before: TensorCameraBelief | None,
    seen: TensorObservation | None,
    motion: Motion | None,
    settings: DiscreteSettings,
) -> tuple[TensorCameraBelief | None, TensorLifted | None]:
    """One camera's belief, and what it says of the keypoints in 3D."""
    since = motion_since(before.world_from_gripper if before else None, motion)
    if seen is None:
        if before is None:
            return None, None
        posterior = replace(
            _predicted(before, before.view, None, replace(settings, restart=0.0)),
            world_from_gripper=before.world_from_gripper if since is None else since.world_from_gripper_before,
        )
        return posterior, _lifted(posterior, torch.zeros_like(posterior.outside), before.view.depth.shape)
    likelihood = _likelihood(seen, settings)
    view = view_of(seen, (likelihood.shape[1], likelihood.shape[2]))
    if before is None:
        prior = _uniform(likelihood, view, seen)
    else:
        prior = _predicted(before, view, since, settings)
    tau = unseen_likelihood(seen.distance, settings.alpha, settings.tau, settings.tau_ratio)
    inside, outside = prior.inside * likelihood, prior.outside * tau
    evidence = (inside.sum(dim=(1, 2)) + outside).clamp(min=LEAST_EVIDENCE)
    told = evidence > LEAST_EVIDENCE
    posterior = replace(
        prior,
        inside=torch.where(told[:, None, None], inside / evidence[:, None, None], prior.inside),
        outside=torch.where(told, outside / evidence, prior.outside),
    )
    return posterior, _lifted(posterior, evidence.log(), seen.depth.shape)


def _likelihood(seen: TensorObservation, settings: DiscreteSettings) -> Float64[Tensor, "k h w"]:
    """The mean likelihood exp(-alpha z) of each cell of the belief."""
    likelihood = (-settings.alpha * seen.distance).double().exp()
    size = (likelihood.shape[1], likelihood.shape[2])
    grid = settings.grid or size
    if grid == size:
        return likelihood
    resizing = _cell_means if grid[0] <= size[0] and grid[1] <= size[1] else _between_pixels
    rows, columns = (resizing(one, new).to(likelihood.device) for one, new in zip(size, grid, strict=True))
    return rows @ likelihood @ columns.T


def _cell_means(n: int, n_new: int) -> Float64[Tensor, "m n"]:
    """The matrix that averages n pixels to fewer, those at an edge by their share."""
    edge = torch.arange(n_new + 1, dtype=torch.float64)[:, None] * (n / n_new)
    pixel = torch.arange(n, dtype=torch.float64)
    return (torch.minimum(edge[1:], pixel + 1) - torch.maximum(edge[:-1], pixel)).clamp(min=0) * (n_new / n)


def _between_pixels(n: int, n_new: int) -> Float64[Tensor, "m n"]:
    """The matrix that interpolates n pixels linearly at the centres of other ones."""
    at = ((torch.arange(n_new, dtype=torch.float64) + 0.5) * (n / n_new) - 0.5).clamp(0, n - 1)
    return (1 - (at[:, None] - torch.arange(n)).abs()).clamp(min=0)


def _uniform(likelihood: Float64[Tensor, "k h w"], view: View, seen: TensorObservation) -> TensorCameraBelief:
    _, height, width = likelihood.shape
    inside = torch.full_like(likelihood, 1.0 / (height * width))
    cell = inside.new_tensor([seen.distance.shape[2] / width, seen.distance.shape[1] / height])
    return TensorCameraBelief(inside, inside.new_zeros(len(inside)), view, cell)


def _predicted(
    belief: TensorCameraBelief, view: View, motion: Motion | None, settings: DiscreteSettings
) -> TensorCameraBelief:
    """The belief before its camera's frame is looked at: carried into the frame's pixel space, and spread."""
    inside, outside = belief.inside, belief.outside
    n_cells = inside[0].numel()
    before = belief.view
    if _moves(before, view, motion, settings):
        inside = _carried(inside, before, view, motion, settings)
        outside = outside + (belief.inside.sum(dim=(1, 2)) - inside.sum(dim=(1, 2))).clamp(min=0)
        uncovered = _uncovered(before, view)
        back = uncovered.sum() / (uncovered.sum() + settings.outside_area * n_cells)
        inside = inside + (outside * back / uncovered.sum().clamp(min=1))[:, None, None] * uncovered
        outside = outside * (1 - back)
    if settings.walk_px > 0:
        sigma = torch.full_like(belief.cell, settings.walk_px) / belief.cell
        rows, columns = _blur(inside.shape[1], sigma[1]), _blur(inside.shape[2], sigma[0])
        blurred = rows @ inside @ columns
        outside = outside + (inside.sum(dim=(1, 2)) - blurred.sum(dim=(1, 2))).clamp(min=0)
        inside = blurred
    inside = (1 - settings.restart) * inside + settings.restart / n_cells
    return TensorCameraBelief(inside, (1 - settings.restart) * outside, view, belief.cell)


def _blur(n: int, sigma: Float64[Tensor, ""]) -> Float64[Tensor, "n n"]:
    """The matrix that blurs n cells; what it takes over the edge is lost. The kernel reaches as far as OpenCV's."""
    step = torch.arange(n, dtype=torch.float64, device=sigma.device)
    apart = (step[:, None] - step).abs()
    reach = ((8 * sigma + 1).round() / 2).floor()
    taps = torch.arange(1, int(reach) + 1, device=sigma.device)
    total = 1 + 2 * (-0.5 * (taps / sigma).square()).exp().sum()
    return torch.where(apart <= reach, (-0.5 * (apart / sigma).square()).exp(), 0.0) / total


def _moves(before: View, now: View, motion: Motion | None, settings: DiscreteSettings) -> bool:
    """Whether camera or gripper do."""
    camera_rests = torch.equal(before.world_from_camera, now.world_from_camera) and torch.equal(before.K, now.K)
    if motion is None or settings.gripper_probability == 0:
        return not camera_rests
    return not (camera_rests and np.array_equal(motion.world_from_gripper_before, motion.world_from_gripper))


def _points(view: View) -> Float64[Tensor, "n 3"]:
    """What the pixels show, world frame."""
    points_camera = unproject(view.pixels(), view.filled.nan_to_num(nan=FAR), view.K).flatten(0, 1)
    return transform(view.world_from_camera, points_camera)


def _seen_from(points_world: Float64[Tensor, "n 3"], view: View) -> Float64[Tensor, "n 2"]:
    """The pixels at which `view` has these points; NaN behind it."""
    rotation, position = view.world_from_camera[:3, :3], view.world_from_camera[:3, 3]
    return project((points_world - position) @ rotation, view.K).round(decimals=9)


def _carried(
    inside: Float64[Tensor, "k h w"], before: View, now: View, motion: Motion | None, settings: DiscreteSettings
) -> Float64[Tensor, "k h w"]:
    """Mass moved with the camera, a part of that near the gripper with the gripper."""
    points, mass = _points(before), inside.flatten(1)
    held = torch.zeros_like(points[:, 0])
    if motion is not None:
        apart = (points - points.new_tensor(motion.world_from_gripper_before[:3, 3])).norm(dim=-1)
        held = settings.gripper_probability * (apart < settings.gripper_reach).to(points.dtype)
    carried = _to_cells(mass * (1 - held), points, now)
    if motion is not None and held.any():
        now_from_before = motion.world_from_gripper @ invert_rigid(motion.world_from_gripper_before)
        carried = carried + _to_cells(mass * held, transform(points.new_tensor(now_from_before), points), now)
    return carried.reshape(inside.shape)


def _to_cells(mass: Float64[Tensor, "k n"], points_world: Float64[Tensor, "n 3"], view: View) -> Float64[Tensor, "k n"]:
    """Each cell's mass brought to the four cells around the place of its point."""
    height, width = view.depth.shape
    uv = _seen_from(points_world, view).nan_to_num(nan=-9.0).clamp(-9.0, max(height, width) + 9.0)
    corner = uv.floor()
    part_u, part_v = (uv - corner).unbind(-1)
    carried = torch.zeros_like(mass)
    for du, dv in ((0, 0), (1, 0), (0, 1), (1, 1)):
        u, v = corner[:, 0].long() + du, corner[:, 1].long() + dv
        weight = (part_u if du else 1 - part_u) * (part_v if dv else 1 - part_v)
        weight = torch.where((u >= 0) & (u < width) & (v >= 0) & (v < height), weight, 0.0)
        carried.index_add_(1, v.clamp(0, height - 1) * width + u.clamp(0, width - 1), mass * weight)
    return carried


def _uncovered(before: View, now: View) -> Bool[Tensor, "h w"]:
    """Cells that show what the view before did not reach."""
    height, width = now.depth.shape
    u, v = _seen_from(_points(now), before).unbind(-1)
    return ~((u >= -0.5) & (u < width - 0.5) & (v >= -0.5) & (v < height - 0.5)).reshape(height, width)


def _lifted(belief: TensorCameraBelief, log_evidence: Float64[Tensor, "k"], image: Sequence[int]) -> TensorLifted:
    """A camera's belief in 3D, pixels as in an image of that size; NaN for a keypoint that is rather outside."""
    inside = belief.inside.sum(dim=(1, 2))[:, None, None]
    height, width = belief.view.depth.shape
    heat = torch.where(inside > 0, belief.inside / inside, 1.0 / (height * width))
    one = lift(heat, belief.view, log_evidence)
    gone = (belief.outside > 0.5)[:, None]
    factor = heat.new_tensor([image[1] / width, image[0] / height])
    return replace(
        one,
        mean=torch.where(gone, math.nan, one.mean),
        mode=torch.where(gone, math.nan, one.mode),
        pixel=(one.pixel + 0.5) * factor - 0.5,
    )
