"""Defects of real sensors in depth and poses. They are applied to the recording, never to ground truth."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt16
from numpy import ndarray

from bask_data.core.geometry import pixel_grid, unproject
from bask_data.sim.options import SimOptions
from bask_data.sim.rendering import RenderedView

DEPTH_SCALE = 1e-4
"""Metres per unit of stored depth: steps of 0.1 mm, up to 6.5 m."""

FLOOR = 0.001
"""Part of the depth noise that does not depend on depth, metres. Chosen."""

DEPTH_EDGE = 0.02
"""Depth difference, metres, between neighbouring pixels at a depth edge, where flying pixels occur. Chosen; sensitivity
not measured."""

POSE_NOISE_M, POSE_NOISE_DEG = 0.002, 0.2
"""Standard deviations of the error of a camera's pose at `--pose-noise 1`, metres along and degrees about each axis.
Chosen."""


def stored(depth: Float32[ndarray, "h w"]) -> UInt16[ndarray, "h w"]:
    """Depth in units of `DEPTH_SCALE`; 0 where it is too large for 16 bits."""
    units = np.rint(depth / np.float32(DEPTH_SCALE))
    return np.where((units > 0) & (units < 65536), units, 0).astype(np.uint16)


def measured(
    view: RenderedView, K: Float[ndarray, "3 3"], options: SimOptions, rng: np.random.Generator
) -> Float32[ndarray, "h w"]:
    """z-depth of a view as measured by a sensor, metres; 0 where it has no measurement."""
    depth = view.depth
    if options.flying:
        depth = with_flying_pixels(depth, options.flying, rng)
    if options.depth_noise:
        sigma = np.float32(FLOOR) + np.float32(options.depth_noise) * depth
        noise = rng.standard_normal(depth.shape, dtype=np.float32)
        depth = np.where(depth > 0, np.maximum(depth + sigma * noise, np.float32(DEPTH_SCALE)), 0)
    if options.holes:
        depth = np.where(holes(view, K, options.holes, rng), np.float32(0), depth)
    return depth.astype(np.float32)


def depth_edges(
    depth: Float32[ndarray, "h w"],
) -> tuple[Bool[ndarray, "h w"], Float32[ndarray, "h w"], Float32[ndarray, "h w"]]:
    """Pixels at depth edges, and the smallest and largest depth around each pixel, metres."""
    kernel = np.ones((3, 3), dtype=np.uint8)
    near = cv2.erode(np.where(depth > 0, depth, np.float32(np.inf)), kernel)
    far = cv2.dilate(depth, kernel)
    return (depth > 0) & (far - near > DEPTH_EDGE), near, far


def with_flying_pixels(
    depth: Float32[ndarray, "h w"], share: float, rng: np.random.Generator
) -> Float32[ndarray, "h w"]:
    """Depth, metres, with a share of the pixels at edges at random between foreground and background."""
    edges, near, far = depth_edges(depth)
    flies = edges & (rng.random(depth.shape) < share)
    near = np.where(edges, near, 0)
    between = near + rng.random(depth.shape, dtype=np.float32) * (far - near)
    return np.where(flies, between, depth).astype(np.float32)


def holes(view: RenderedView, K: Float[ndarray, "3 3"], share: float, rng: np.random.Generator) -> Bool[ndarray, "h w"]:
    """Pixels of patches without depth, a share of those with depth: mostly at grazing angles and on glass."""
    height, width = view.depth.shape
    cells = rng.random((height // 12 + 2, width // 12 + 2)).astype(np.float32)
    patches = cv2.resize(cells, (width, height), interpolation=cv2.INTER_CUBIC)
    score = patches + 0.8 * grazing(view.depth, K) ** 3 + 0.6 * view.is_glass
    has_depth = view.depth > 0
    if not has_depth.any():
        return np.zeros_like(has_depth)
    return has_depth & (score > np.quantile(score[has_depth], 1 - share))


def grazing(depth: Float32[ndarray, "h w"], K: Float[ndarray, "3 3"]) -> Float[ndarray, "h w"]:
    """Grazing of each pixel's surface: 0 facing the camera, 1 edge-on."""
    points = unproject(pixel_grid(*depth.shape), depth.astype(np.float64), K)
    normals = np.cross(_smaller_step(points, 1), _smaller_step(points, 0))
    lengths = np.linalg.norm(normals, axis=-1) * np.linalg.norm(points, axis=-1)
    return 1 - np.abs((normals * points).sum(axis=-1)) / np.maximum(lengths, 1e-12)


def _smaller_step(points: Float[ndarray, "h w 3"], axis: int) -> Float[ndarray, "h w 3"]:
    """Step to the neighbour along an axis with the smaller depth difference, which does not cross a depth edge."""
    steps = np.diff(points, axis=axis)
    first, last = (np.take(steps, [i], axis=axis) for i in (0, -1))
    before, after = np.concatenate([first, steps], axis=axis), np.concatenate([steps, last], axis=axis)
    return np.where(np.abs(before[..., 2:]) < np.abs(after[..., 2:]), before, after)


def noisy_poses(
    world_from_cameras: Float[ndarray, "t 4 4"], factor: float, is_fixed: bool, rng: np.random.Generator
) -> Float[ndarray, "t 4 4"]:
    """Camera poses with noise: independent in each frame, or constant for a fixed camera.

    Args:
        factor: standard deviation in units of `POSE_NOISE_M` along and `POSE_NOISE_DEG` about each axis.
    """
    if not factor:
        return world_from_cameras
    n_errors = 1 if is_fixed else len(world_from_cameras)
    shifts = rng.normal(0, factor * POSE_NOISE_M, (n_errors, 3))
    turns = rng.normal(0, np.radians(factor * POSE_NOISE_DEG), (n_errors, 3))
    errors = np.tile(np.eye(4), (n_errors, 1, 1))
    errors[:, :3, :3] = [cv2.Rodrigues(turn)[0] for turn in turns]
    noisy = world_from_cameras @ errors
    noisy[:, :3, 3] = world_from_cameras[:, :3, 3] + shifts
    return noisy
