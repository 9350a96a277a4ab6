"""Heat maps on tensors: lifted to 3D, fused over cameras, and the filter of single frames (`core.heatmap`)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from bask_data.core.geometry import scale_intrinsics
from bask_data.core.heatmap import LIFT_RADIUS, POSITION_VARIANCE, ExpectationSettings, fill_depth, shrink_depth
from bask_data.nn.filters.frames import (
    TensorEstimate,
    TensorObservation,
    n_keypoints,
    nothing_known,
    projections,
    transform,
    unproject,
)


@dataclass(frozen=True)
class View:
    """Depth at the resolution of heat maps, with and without holes, and its camera.

    Attributes:
        filled: each hole as its nearest measurement; NaN everywhere if there is none.
    """

    depth: Float64[Tensor, "h w"]
    filled: Float64[Tensor, "h w"]
    K: Float64[Tensor, "3 3"]
    world_from_camera: Float64[Tensor, "4 4"]

    def pixels(self) -> Float64[Tensor, "h w 2"]:
        """The (u, v) of every pixel centre."""
        v, u = (torch.arange(n, dtype=torch.float64, device=self.depth.device) for n in self.depth.shape)
        return torch.stack(torch.meshgrid(u, v, indexing="xy"), dim=-1)


@dataclass(frozen=True)
class TensorLifted:
    """Heat maps of one camera in 3D; `n_eff` in pixels. NaN where no pixel has depth."""

    mean: Float64[Tensor, "k 3"]
    covariance: Float64[Tensor, "k 3 3"]
    mode: Float64[Tensor, "k 3"]
    pixel: Float64[Tensor, "k 2"]
    peak: Float64[Tensor, "k"]
    n_eff: Float64[Tensor, "k"]
    log_evidence: Float64[Tensor, "k"]


def expectation_step(
    belief: TensorEstimate | None, observations: Sequence[TensorObservation | None], settings: ExpectationSettings
) -> tuple[TensorEstimate, TensorEstimate]:
    """Belief and estimate after one more frame: `core.heatmap.expectation_step` on tensors."""
    lifted: list[TensorLifted | None] = []
    for seen in observations:
        if seen is None:
            lifted.append(None)
            continue
        heat, log_evidence = softmax_map(seen.distance, settings.alpha)
        lifted.append(lift(heat, view_of(seen, (heat.shape[1], heat.shape[2])), log_evidence))
    k = n_keypoints(observations) if belief is None else len(belief.mean)
    estimate = keep_last(fuse(lifted, k), belief, observations)
    return estimate, estimate


def view_of(seen: TensorObservation, size: tuple[int, int]) -> View:
    """The camera's view at a resolution (height, width). Depth is shrunk and filled on the CPU, as for arrays."""
    depth = shrink_depth(seen.depth.cpu().numpy(), size)
    K = scale_intrinsics(seen.K.cpu().numpy(), (seen.depth.shape[0], seen.depth.shape[1]), size)
    here, filled, K_here = (torch.as_tensor(one, device=seen.K.device) for one in (depth, fill_depth(depth), K))
    return View(here, filled, K_here, seen.world_from_camera)


def softmax_map(
    distance: Float[Tensor, "k h w"], alpha: float
) -> tuple[Float64[Tensor, "k h w"], Float64[Tensor, "k"]]:
    """The heat map softmax(-alpha z) over all pixels, and the log of the mean of exp(-alpha z)."""
    nearest = distance.amin(dim=(1, 2))
    heat = (-alpha * (distance - nearest[:, None, None])).double().exp()
    total = heat.sum(dim=(1, 2))
    return heat / total[:, None, None], (total / distance[0].numel()).log() - alpha * nearest.double()


def lift(heat: Float64[Tensor, "k h w"], view: View, log_evidence: Float64[Tensor, "k"]) -> TensorLifted:
    """Mean, mode and covariance of heat maps, each of which sums to one, in the world frame."""
    grid = view.pixels()
    pixel = torch.stack([heat.sum(dim=1) @ grid[0, :, 0], heat.sum(dim=2) @ grid[:, 0, 1]], dim=-1)
    peak, at = heat.flatten(1).max(dim=1)
    peak_pixel = grid.flatten(0, 1)[at]
    mean, mode = (
        transform(view.world_from_camera, unproject(one, _depth_at(heat, view, one), view.K))
        for one in (pixel, peak_pixel)
    )
    n_eff = 1.0 / heat.square().sum(dim=(1, 2))
    return TensorLifted(mean, _lifted_covariance(heat, view), mode, pixel, peak, n_eff, log_evidence)


def _depth_at(heat: Float64[Tensor, "k h w"], view: View, pixel: Float64[Tensor, "k 2"]) -> Float64[Tensor, "k"]:
    """The heat's median depth around one pixel each; NaN in an image without depth."""
    k, height, width = heat.shape
    u, v = pixel.round().long().unbind(-1)
    reach = torch.arange(-LIFT_RADIUS, LIFT_RADIUS + 1, device=heat.device)
    rows, columns = v[:, None, None] + reach[:, None], u[:, None, None] + reach
    inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
    rows, columns = rows.clamp(0, height - 1), columns.clamp(0, width - 1)
    near = view.depth[rows, columns]
    counts = inside & (near > 0)
    weight = torch.where(counts, heat[torch.arange(k, device=heat.device)[:, None, None], rows, columns], 0.0)
    near, order = torch.where(counts, near, math.inf).flatten(1).sort(dim=1, stable=True)
    total = weight.flatten(1).gather(1, order).cumsum(dim=1)
    middle = torch.searchsorted(total, 0.5 * total[:, -1:])
    return torch.where(total[:, -1] > 0, near.gather(1, middle)[:, 0], view.filled[v, u])


def _lifted_covariance(heat: Float64[Tensor, "k h w"], view: View) -> Float64[Tensor, "k 3 3"]:
    """Spread of the heat over the measured surface, world frame; NaN where it has no weight on any measurement."""
    points = unproject(view.pixels(), view.depth, view.K).flatten(0, 1)
    measured = (view.depth > 0).double().flatten()[:, None]
    points = (points - (measured * points).sum(dim=0) / measured.sum()) * measured
    products = (points[:, :, None] * points[:, None]).flatten(1)
    moments = heat.flatten(1) @ torch.cat([measured, points, products], dim=1)
    moments = moments[:, 1:] / moments[:, :1]
    mean, second = moments[:, :3], moments[:, 3:].unflatten(1, (3, 3))
    rotation = view.world_from_camera[:3, :3]
    return rotation @ (second - mean[:, :, None] * mean[:, None]) @ rotation.T


def fuse(lifted: Sequence[TensorLifted | None], k: int) -> TensorEstimate:
    """One estimate of several cameras: means weighted by inverse covariance, the mode of the sharpest heat map."""
    given = [one for one in lifted if one is not None]
    if not given:
        return nothing_known(len(lifted), k)
    nothing = nothing_known(len(lifted), k, given[0].mean.device)
    one_each = torch.eye(3, dtype=torch.float64, device=given[0].mean.device).expand(k, 3, 3)
    information, weighted = torch.zeros_like(one_each), torch.zeros_like(nothing.mean)
    for one in given:
        known = one.mean.isfinite().all(dim=1) & one.covariance.flatten(1).isfinite().all(dim=1)
        covariance = torch.where(known[:, None, None], one.covariance, one_each)
        inverse = torch.linalg.inv(covariance + POSITION_VARIANCE * one_each) * known[:, None, None]
        information = information + inverse
        weighted = weighted + torch.einsum("kij,kj->ki", inverse, one.mean.nan_to_num())
    any_known = information.diagonal(dim1=1, dim2=2).sum(dim=1) > 0
    covariance = torch.linalg.inv(torch.where(any_known[:, None, None], information, one_each))
    mean = torch.einsum("kij,kj->ki", covariance, weighted)
    peaks = torch.stack([torch.where(one.mode[:, 0].isfinite(), one.peak, -1.0) for one in given])
    modes = torch.stack([one.mode for one in given])
    return TensorEstimate(
        mean=torch.where(any_known[:, None], mean, nothing.mean),
        covariance=torch.where(any_known[:, None, None], covariance, nothing.covariance),
        mode=modes[peaks.argmax(dim=0), torch.arange(k, device=mean.device)],
        n_eff=torch.stack([one.n_eff for one in given]).mean(dim=0),
        log_evidence=torch.stack([one.log_evidence for one in given]).sum(dim=0),
        pixel=torch.stack([nothing.pixel[i] if one is None else one.pixel for i, one in enumerate(lifted)]),
        observed=torch.stack(
            [nothing.observed[i] if one is None else one.mean.isfinite().all(dim=1) for i, one in enumerate(lifted)]
        ),
    )


def keep_last(
    now: TensorEstimate, last: TensorEstimate | None, observations: Sequence[TensorObservation | None]
) -> TensorEstimate:
    """`now`, with the last estimate where no camera could be lifted; its pixels are then those of the kept point."""
    if last is None:
        return now
    now = TensorEstimate(**{name: value.to(last.mean.device) for name, value in vars(now).items()})
    lost = now.mean.isnan().any(dim=1)
    mean = torch.where(lost[:, None], last.mean, now.mean)
    return TensorEstimate(
        mean=mean,
        covariance=torch.where(lost[:, None, None], last.covariance, now.covariance),
        mode=torch.where(lost[:, None], last.mode, now.mode),
        n_eff=now.n_eff,
        log_evidence=now.log_evidence,
        pixel=torch.where(lost[None, :, None], projections(mean, observations), now.pixel),
        observed=now.observed,
    )
