"""Heat maps, a probability over the pixels of a camera for each keypoint, and their lifting to 3D by measured depth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from bask_data.core.filters.observation import Estimate, Observation, nothing_known, projections
from bask_data.core.filters.per_keypoint import per_keypoint
from bask_data.core.filters.table import PerKeypoint
from bask_data.core.geometry import pixel_grid, transform, unproject
from bask_data.core.nearest_depth import fill_depth

LIFT_RADIUS = 3
"""Half the window, pixels of the distance map, in which the depth of a lifted pixel is searched: wide enough to find a
measurement beside the holes that depth cameras leave at edges. Chosen, sensitivity not measured."""

TAU_STRIDE = 2
"""Step, in rows and columns, of the pixels that the mean likelihood of an image is estimated from. Chosen, sensitivity
not measured."""

TAU_MOST = 0.3
"""Upper bound of tau: a likelihood above it is a match, even if the whole image has it. With the default ratio of 2,
tracking worked alike for background at descriptor distances 0.5, 0.6, 0.8 and 1.2 (7-Scenes `redkitchen`)."""

POSITION_VARIANCE = 1e-6
"""Square metres added to each camera's covariance before fusion: no camera is more accurate than a millimetre. Chosen,
sensitivity not measured."""


def softmax_map(
    distance: Float[ndarray, "k h w"], alpha: PerKeypoint
) -> tuple[Float[ndarray, "k h w"], Float[ndarray, "k"]]:
    """The heat map softmax(-alpha z) over all pixels, and the log of the mean of exp(-alpha z).

    Source: von Hartz et al. 2023, Sec. III-A.3.
    """
    nearest = distance.min(axis=(1, 2))
    each = per_keypoint(alpha, len(distance), "alpha")
    heat = np.exp(-each.astype(distance.dtype)[:, None, None] * (distance - nearest[:, None, None]), dtype=np.float64)
    total = heat.sum(axis=(1, 2))
    heat /= total[:, None, None]
    return heat, np.log(total / distance[0].size) - each * nearest.astype(np.float64)


def unseen_likelihood(
    distance: Float[ndarray, "k h w"], alpha: PerKeypoint, tau: PerKeypoint | None, ratio: PerKeypoint
) -> Float[ndarray, "k"]:
    """tau of each keypoint: the likelihood of an image that does not show it; `tau` itself unless it is None.

    The ratio of exp(-alpha z) at a pixel to tau decides whether the keypoint is there or not visible. A constant suits
    the distances of one network only: below the likelihood of background, distractors win when the keypoint leaves the
    view; above that of matches, visible keypoints are lost. The default is a multiple of the likelihood's mean over the
    image. At a ratio of one, an image without the keypoint would on average be no evidence for or against; but
    distractors match in every frame, and a larger ratio suppresses them. It is bounded for images that the keypoint's
    surroundings fill.

    Args:
        tau: constant likelihood; None for the default.
        ratio: the multiple.
    """
    if tau is not None:
        return per_keypoint(tau, len(distance), "tau")
    each = per_keypoint(alpha, len(distance), "alpha").astype(distance.dtype)
    mean = np.exp(-each[:, None, None] * distance[:, ::TAU_STRIDE, ::TAU_STRIDE]).mean(axis=(1, 2))
    ratios = per_keypoint(ratio, len(distance), "tau_ratio").astype(mean.dtype)
    return np.clip(ratios * mean, np.finfo(np.float32).tiny, TAU_MOST).astype(np.float64)


@dataclass(frozen=True)
class Lifted:
    """Heat maps of one camera in 3D, world frame; NaN where no pixel has depth. `n_eff` counts pixels."""

    mean: Float[ndarray, "k 3"]
    covariance: Float[ndarray, "k 3 3"]
    mode: Float[ndarray, "k 3"]
    pixel: Float[ndarray, "k 2"]
    peak: Float[ndarray, "k"]
    n_eff: Float[ndarray, "k"]
    log_evidence: Float[ndarray, "k"]


def lift(
    heat: Float[ndarray, "k h w"], seen: Observation, log_evidence: Float[ndarray, "k"], radius: int = LIFT_RADIUS
) -> Lifted:
    """Mean, mode and covariance of heat maps in the world frame.

    The mean pixel is lifted, because the mean of the lifted pixels would float between foreground and background. Its
    depth is the median of the measured depths around it, weighted by the heat map: always a depth that was measured,
    and at an edge that of the side with the most heat.

    Args:
        heat: each sums to one; of the same size as `seen.depth`.
        radius: half the window, pixels, in which depths are searched; without any, the nearest measurement counts.
    """
    k, height, width = heat.shape
    u, v = np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64)
    pixel = np.stack([heat.sum(axis=1) @ u, heat.sum(axis=2) @ v], axis=-1)
    peak_index = heat.reshape(k, -1).argmax(axis=1)
    peak_pixel = np.stack([peak_index % width, peak_index // width], axis=-1).astype(np.float64)
    filled = fill_depth(seen.depth)
    depths = np.array([_depth_at(heat[i], seen.depth, filled, pixel[i], radius) for i in range(k)])
    peak_depths = np.array([_depth_at(heat[i], seen.depth, filled, peak_pixel[i], radius) for i in range(k)])
    return Lifted(
        mean=transform(seen.world_from_camera, unproject(pixel, depths, seen.K)),
        covariance=_lifted_covariance(heat, seen),
        mode=transform(seen.world_from_camera, unproject(peak_pixel, peak_depths, seen.K)),
        pixel=pixel,
        peak=heat.reshape(k, -1).max(axis=1),
        n_eff=1.0 / np.einsum("khw,khw->k", heat, heat),
        log_evidence=log_evidence,
    )


def _depth_at(
    heat: Float[ndarray, "h w"],
    depth: Float[ndarray, "h w"],
    filled: Float[ndarray, "h w"],
    pixel: Float[ndarray, "2"],
    radius: int,
) -> float:
    """The heat's median depth around a pixel; NaN in an image without depth."""
    u, v = np.rint(pixel).astype(int)
    window = np.s_[max(v - radius, 0) : v + radius + 1, max(u - radius, 0) : u + radius + 1]
    near, weight = depth[window].ravel(), heat[window].ravel()
    measured = near > 0
    near, weight = near[measured], weight[measured]
    if weight.sum() <= 0:
        return float(filled[v, u])
    order = np.argsort(near, kind="stable")
    total = np.cumsum(weight[order])
    return float(near[order][np.searchsorted(total, 0.5 * total[-1])])


def _lifted_covariance(heat: Float[ndarray, "k h w"], seen: Observation) -> Float[ndarray, "k 3 3"]:
    """Covariance of the heat over the measured surface, world frame; NaN without weight on any measurement."""
    height, width = seen.depth.shape
    points = unproject(pixel_grid(height, width), seen.depth.astype(np.float64), seen.K).reshape(-1, 3)
    measured = (seen.depth > 0).ravel()
    if not measured.any():
        return np.full((len(heat), 3, 3), np.nan)
    points = (points - points[measured].mean(axis=0)) * measured[:, None]
    rows, columns = np.triu_indices(3)
    moments = heat.reshape(len(heat), -1) @ np.concatenate(
        [measured[:, None], points, points[:, rows] * points[:, columns]], axis=1
    )
    with np.errstate(invalid="ignore"):
        moments = moments[:, 1:] / moments[:, :1]
    second = np.empty((len(heat), 3, 3))
    second[:, rows, columns] = second[:, columns, rows] = moments[:, 3:]
    covariance = second - moments[:, :3, None] * moments[:, None, :3]
    rotation = seen.world_from_camera[:3, :3]
    return rotation @ covariance @ rotation.T


def fuse(lifted: Sequence[Lifted | None], k: int) -> Estimate:
    """One estimate from several cameras: means weighted by inverse covariance, the mode of the sharpest heat map.

    Args:
        lifted: of each camera, None for one without a frame.
        k: number of keypoints.
    """
    given = [one for one in lifted if one is not None]
    nothing = nothing_known(len(lifted), k)
    if not given:
        return nothing
    information, weighted = np.zeros((k, 3, 3)), np.zeros((k, 3))
    for one in given:
        known = np.isfinite(one.mean).all(axis=1) & np.isfinite(one.covariance).all(axis=(1, 2))
        inverse = np.linalg.inv(one.covariance[known] + POSITION_VARIANCE * np.eye(3))
        information[known] += inverse
        weighted[known] += np.einsum("kij,kj->ki", inverse, one.mean[known])
    mean, covariance = nothing.mean.copy(), nothing.covariance
    any_known = np.trace(information, axis1=1, axis2=2) > 0
    covariance[any_known] = np.linalg.inv(information[any_known])
    mean[any_known] = np.einsum("kij,kj->ki", covariance[any_known], weighted[any_known])
    sharpest = np.argmax([np.where(np.isfinite(one.mode[:, 0]), one.peak, -1.0) for one in given], axis=0)
    return Estimate(
        mean=mean,
        covariance=covariance,
        mode=np.stack([one.mode for one in given])[sharpest, np.arange(k)],
        n_eff=np.mean([one.n_eff for one in given], axis=0),
        log_evidence=np.sum([one.log_evidence for one in given], axis=0),
        pixel=np.stack([nothing.pixel[i] if one is None else one.pixel for i, one in enumerate(lifted)]),
        observed=np.stack(
            [nothing.observed[i] if one is None else np.isfinite(one.mean).all(axis=1) for i, one in enumerate(lifted)]
        ),
    )


def keep_last(now: Estimate, last: Estimate | None, observations: Sequence[Observation | None]) -> Estimate:
    """`now`, with the last estimate where no camera gives one; its pixels are then projections of the kept point."""
    lost = np.isnan(now.mean).any(axis=1)
    if last is None or not lost.any():
        return now
    mean = np.where(lost[:, None], last.mean, now.mean)
    return Estimate(
        mean=mean,
        covariance=np.where(lost[:, None, None], last.covariance, now.covariance),
        mode=np.where(lost[:, None], last.mode, now.mode),
        n_eff=now.n_eff,
        log_evidence=now.log_evidence,
        pixel=np.where(lost[None, :, None], projections(mean, observations), now.pixel),
        observed=now.observed,
    )
