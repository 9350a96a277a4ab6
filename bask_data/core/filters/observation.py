"""What goes into a filter and what comes out: a camera's frame, the gripper's motion, the estimate of the keypoints."""

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
    """What one camera sees of k keypoints in one frame.

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
    """What is known of the time between two frames: how the gripper moved."""

    world_from_gripper_before: Float[ndarray, "4 4"]
    world_from_gripper: Float[ndarray, "4 4"]


@dataclass(frozen=True)
class Estimate:
    """Where k keypoints are, given all frames so far. NaN where nothing has been seen that could be lifted to 3D."""

    mean: Float[ndarray, "k 3"]
    """Metres, world frame."""
    covariance: Float[ndarray, "k 3 3"]
    mode: Float[ndarray, "k 3"]
    n_eff: Float[ndarray, "k"]
    """Effective number of hypotheses: 1 / sum of squared weights."""
    log_evidence: Float[ndarray, "k"]
    """Log of the likelihood of this frame given the ones before it."""
    pixel: Float[ndarray, "c k 2"]
    """(u, v) in each camera, of `depth`'s image; may lie outside of it. NaN behind the camera, and in a camera that
    gave no frame."""
    observed: Bool[ndarray, "c k"]
    """Whether the camera more likely than not sees the keypoint; False where it gave no frame."""


@dataclass(frozen=True)
class WeightedPoints:
    """A belief over 3D points; the weights of each keypoint sum to one."""

    points_world: Float[ndarray, "k n 3"]
    weight: Float[ndarray, "k n"]


@dataclass(frozen=True)
class PixelMaps:
    """A belief over pixels: for each camera, in the order of the observations, a map of each keypoint (k, h, w) that
    spans its image; None for a camera that has none."""

    maps: tuple[ndarray | None, ...]


def n_keypoints(observations: Sequence[Observation | None]) -> int:
    """Number of keypoints that the frames speak of; 0 without any frame."""
    return next((len(seen.distance) for seen in observations if seen is not None), 0)


def nothing_known(n_cameras: int, k: int) -> Estimate:
    """The estimate of k keypoints before there is anything to estimate them from."""
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
    """Where world points lie in each camera's image; NaN behind the camera, and where it gave no frame."""
    pixels = np.full((len(observations), len(points_world), 2), np.nan)
    for i, seen in enumerate(observations):
        if seen is not None:
            pixels[i] = pixels_of(points_world, seen)
    return pixels


def pixels_of(points_world: Float[ndarray, "*n 3"], seen: Observation) -> Float[ndarray, "*n 2"]:
    """Where world points lie in the camera's image; NaN behind the camera."""
    rotation, position = seen.world_from_camera[:3, :3], seen.world_from_camera[:3, 3]
    return project((points_world - position) @ rotation, seen.K)[0]


def fitted(seen: Observation) -> Observation:
    """The same observation with depth and intrinsics at the resolution of the distance maps.

    Sparse depth gets denser by it, and the filters faster.
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
