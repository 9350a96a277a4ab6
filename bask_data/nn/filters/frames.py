"""What the filters on tensors share: a camera's frame, the estimate, and the pinhole camera."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from bask_data.core.heatmap import TAU_MOST, TAU_STRIDE, Estimate, Observation, shrink_depth


@dataclass(frozen=True)
class TensorObservation:
    """An `Observation` on a device; `map_depth` is its depth at the resolution of the maps."""

    distance: Float[Tensor, "k hz wz"]
    depth: Float64[Tensor, "h w"]
    map_depth: Float64[Tensor, "hz wz"]
    K: Float64[Tensor, "3 3"]
    world_from_camera: Float64[Tensor, "4 4"]


@dataclass(frozen=True)
class TensorEstimate:
    """An `Estimate` on a device, field by field."""

    mean: Float64[Tensor, "k 3"]
    covariance: Float64[Tensor, "k 3 3"]
    mode: Float64[Tensor, "k 3"]
    n_eff: Float64[Tensor, "k"]
    log_evidence: Float64[Tensor, "k"]
    pixel: Float64[Tensor, "c k 2"]
    observed: Bool[Tensor, "c k"]


def observation_on(seen: Observation, device: torch.device | str = "cpu") -> TensorObservation:
    """A camera's frame on a device."""
    map_depth = shrink_depth(seen.depth, (seen.distance.shape[1], seen.distance.shape[2]))
    return TensorObservation(
        distance=torch.as_tensor(seen.distance, device=device),
        depth=torch.as_tensor(seen.depth, device=device).double(),
        map_depth=torch.as_tensor(map_depth, device=device).double(),
        K=torch.as_tensor(seen.K, device=device).double(),
        world_from_camera=torch.as_tensor(seen.world_from_camera, device=device).double(),
    )


def estimate_on(estimate: Estimate, device: torch.device | str = "cpu") -> TensorEstimate:
    """An estimate on a device."""
    return TensorEstimate(
        **{one.name: torch.as_tensor(getattr(estimate, one.name), device=device) for one in fields(estimate)}
    )


def estimate_from(estimate: TensorEstimate) -> Estimate:
    """An estimate back from its device."""
    return Estimate(**{one.name: getattr(estimate, one.name).cpu().numpy() for one in fields(estimate)})


def nothing_known(n_cameras: int, k: int, device: torch.device | str = "cpu") -> TensorEstimate:
    """The estimate of k keypoints before there is anything to estimate them from."""
    nan = torch.full((n_cameras + 4, k, 3), math.nan, dtype=torch.float64, device=device)
    return TensorEstimate(
        mean=nan[0],
        covariance=nan[:3].transpose(0, 1),
        mode=nan[0],
        n_eff=nan.new_zeros(k),
        log_evidence=nan.new_zeros(k),
        pixel=nan[4:, :, :2],
        observed=nan.new_zeros((n_cameras, k), dtype=torch.bool),
    )


def n_keypoints(observations: Sequence[TensorObservation | None]) -> int:
    """Number of keypoints that the frames speak of; 0 without any frame."""
    return next((len(seen.distance) for seen in observations if seen is not None), 0)


def unseen_likelihood(
    distance: Float[Tensor, "k hz wz"], alpha: float, tau: float | None, ratio: float
) -> Float64[Tensor, "k"]:
    """tau of each keypoint: the likelihood of an image that does not show it; `tau` itself unless it is None."""
    if tau is not None:
        return torch.full((len(distance),), tau, dtype=torch.float64, device=distance.device)
    mean = (-alpha * distance[:, ::TAU_STRIDE, ::TAU_STRIDE]).exp().mean(dim=(1, 2)).double()
    return (ratio * mean).clamp(float(np.finfo(np.float32).tiny), TAU_MOST)


def transform(a_from_b: Float64[Tensor, "4 4"], points_b: Float64[Tensor, "*n 3"]) -> Float64[Tensor, "*n 3"]:
    """The same points in frame a."""
    return points_b @ a_from_b[:3, :3].T + a_from_b[:3, 3]


def project(points_camera: Float64[Tensor, "*n 3"], K: Float64[Tensor, "3 3"]) -> Float64[Tensor, "*n 2"]:
    """Pixels (u, v); NaN for points that are not in front of the camera."""
    x, y, z = points_camera.unbind(-1)
    in_front = torch.where(z > 0, z, math.nan)
    u = K[0, 0] * x / in_front + K[0, 1] * y / in_front + K[0, 2]
    return torch.stack([u, K[1, 1] * y / in_front + K[1, 2]], dim=-1)


def unproject(
    uv: Float64[Tensor, "*n 2"], depth: Float64[Tensor, "*n"], K: Float64[Tensor, "3 3"]
) -> Float64[Tensor, "*n 3"]:
    """Points in the camera frame seen at pixels (u, v) at z-depth `depth` (metres)."""
    y = (uv[..., 1] - K[1, 2]) / K[1, 1]
    x = (uv[..., 0] - K[0, 2] - K[0, 1] * y) / K[0, 0]
    return torch.stack([x * depth, y * depth, depth], dim=-1)


def projections(
    points_world: Float64[Tensor, "k 3"], observations: Sequence[TensorObservation | None]
) -> Float64[Tensor, "c k 2"]:
    """Where world points lie in each camera's image; NaN behind the camera, and where it gave no frame."""
    pixels = points_world.new_full((len(observations), len(points_world), 2), math.nan)
    for i, seen in enumerate(observations):
        if seen is not None:
            rotation, position = seen.world_from_camera[:3, :3], seen.world_from_camera[:3, 3]
            pixels[i] = project((points_world - position) @ rotation, seen.K)
    return pixels
