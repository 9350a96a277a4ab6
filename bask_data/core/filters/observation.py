"""Input and output of a filter: a camera's frame, the gripper's motion, the estimate of the keypoints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from bask_data.core.geometry import project, scale_intrinsics
from bask_data.core.nearest_depth import shrink_depth


@dataclass(frozen=True)
class Observation:
    """One camera's frame, with a distance map for each of k keypoints.

    `distance` may be coarser than `depth`; both span the same image, edge to edge. `K` belongs to `depth`.
    """

    distance: Float[ndarray, "k hz wz"]
    """Descriptor distance of each pixel to each keypoint's reference."""
    depth: Float[ndarray, "h w"]
    """z-depth, metres; 0 = no measurement."""
    K: Float[ndarray, "3 3"]
    world_from_camera: Float[ndarray, "4 4"]


@dataclass(frozen=True)
class Motion:
    """The gripper's motion between two frames."""

    world_from_gripper_before: Float[ndarray, "4 4"]
    world_from_gripper: Float[ndarray, "4 4"]


@dataclass(frozen=True)
class Estimate:
    """The positions of k keypoints given all frames so far; NaN before any observation could be lifted to 3D."""

    mean: Float[ndarray, "k 3"]
    """Metres, world frame."""
    covariance: Float[ndarray, "k 3 3"]
    mode: Float[ndarray, "k 3"]
    n_eff: Float[ndarray, "k"]
    """Effective sample size: 1 / sum of squared weights."""
    log_evidence: Float[ndarray, "k"]
    """Log of the likelihood of this frame given the previous ones."""
    pixel: Float[ndarray, "c k 2"]
    """(u, v) in each camera's depth image; may lie outside of it. NaN behind the camera, and in a camera without a
    frame."""
    observed: Bool[ndarray, "c k"]
    """Whether the camera more likely than not sees the keypoint; False for a camera without a frame."""


@dataclass(frozen=True)
class WeightedPoints:
    """A belief over 3D points, metres; the weights of each keypoint sum to one."""

    points_world: Float[ndarray, "k n 3"]
    weight: Float[ndarray, "k n"]


@dataclass(frozen=True)
class PixelMaps:
    """A belief over pixels: for each camera, in the order of the observations, a map for each keypoint (k, h, w) that
    spans its image; None for a camera without one."""

    maps: tuple[ndarray | None, ...]


def n_keypoints(observations: Sequence[Observation | None]) -> int:
    """Number of keypoints in the frames; 0 without any frame."""
    return next((len(seen.distance) for seen in observations if seen is not None), 0)


def nothing_known(n_cameras: int, k: int) -> Estimate:
    """The estimate of k keypoints before any observation."""
    unknown = np.full((k, 3), np.nan)
    return Estimate(
        mean=unknown,
        covariance=np.full((k, 3, 3), np.nan),
        mode=unknown,
        n_eff=np.zeros(k),
        log_evidence=np.zeros(k),
        pixel=np.full((n_cameras, k, 2), np.nan),
        observed=np.zeros((n_cameras, k), dtype=bool),
    )


def projections(
    points_world: Float[ndarray, "k 3"], observations: Sequence[Observation | None]
) -> Float[ndarray, "c k 2"]:
    """Pixels of world points in each camera; NaN behind the camera, and for a camera without a frame."""
    pixels = np.full((len(observations), len(points_world), 2), np.nan)
    for i, seen in enumerate(observations):
        if seen is not None:
            pixels[i] = pixels_of(points_world, seen)
    return pixels


def pixels_of(points_world: Float[ndarray, "*n 3"], seen: Observation) -> Float[ndarray, "*n 2"]:
    """Pixels of world points in one camera; NaN behind it."""
    rotation, position = seen.world_from_camera[:3, :3], seen.world_from_camera[:3, 3]
    return project((points_world - position) @ rotation, seen.K)[0]


def fitted(seen: Observation) -> Observation:
    """The same observation with depth and intrinsics at the resolution of the distance maps.

    Sparse depth becomes denser, and filters faster.
    """
    size, map_size = seen.depth.shape, seen.distance.shape[1:]
    if size == map_size:
        return seen
    return Observation(
        distance=seen.distance,
        depth=shrink_depth(seen.depth, map_size),
        K=scale_intrinsics(seen.K, size, map_size),
        world_from_camera=seen.world_from_camera,
    )
