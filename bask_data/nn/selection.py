"""Automatic choice of reference keypoints: points re-found in other views and spread over an object."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray
from numpy.random import Generator

from bask_data.core.geometry import in_image, invert_rigid, project, transform
from bask_data.nn.network import best_matches, distance_maps

FOUND = 0.03
"""Largest error, as a share of the image's diagonal, at which a point counts as re-found: 14 pixels of 400x240.
Chosen; sensitivity not measured."""

DEPTH_TOLERANCE = 0.015
"""Largest difference, metres, between the measured depth and that of a visible point: sensor noise and pose errors.
Chosen; sensitivity not measured."""


@dataclass(frozen=True)
class SelectionView:
    """A frame in which candidates are searched; `descriptors` may be coarser than `depth`, both span the same image.

    Args:
        instance: visible instance at each pixel, 0 = none; None: unknown.
    """

    descriptors: Float[torch.Tensor, "d hd wd"]
    depth: Float[ndarray, "h w"]
    K: Float[ndarray, "3 3"]
    world_from_camera: Float[ndarray, "4 4"]
    instance: UInt8[ndarray, "h w"] | None = None


def inner_pixels(
    mask: Bool[ndarray, "h w"], depth: Float[ndarray, "h w"], border: float, n: int, rng: Generator
) -> Float[ndarray, "m 2"]:
    """Up to n random pixels (u, v) with measured depth, more than `border` pixels inside a mask and the image."""
    padded = np.pad(mask.astype(np.uint8), 1)
    inside = cv2.distanceTransform(padded, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[1:-1, 1:-1] > border
    v, u = np.nonzero(inside & (depth > 0))
    chosen = rng.permutation(len(u))[:n]
    return np.stack([u[chosen], v[chosen]], axis=-1).astype(np.float64)


def found_again(
    points_world: Float[ndarray, "n 3"], descriptors: Float[torch.Tensor, "n d"], views: Iterable[SelectionView]
) -> tuple[Float[ndarray, "n"], Int[ndarray, "n"]]:
    """Share of the views showing a point in which its descriptor re-finds it, and the number of these views.

    Args:
        points_world: metres.
        descriptors: of the points, from other frames than `views`.
    """
    hits, shown = np.zeros(len(points_world)), np.zeros(len(points_world), int)
    for view in views:
        height, width = view.depth.shape
        uv, z = project(transform(invert_rigid(view.world_from_camera), points_world), view.K)
        inside = in_image(uv, height, width)
        column, row = np.rint(np.where(inside[:, None], uv, 0)).astype(int).T
        column, row = column.clip(0, width - 1), row.clip(0, height - 1)
        visible = inside & (np.abs(view.depth[row, column] - z) < DEPTH_TOLERANCE)
        if not visible.any():
            continue
        distances = distance_maps(view.descriptors, descriptors[torch.from_numpy(np.flatnonzero(visible))])
        matched = best_matches(distances, (height, width))
        error = np.linalg.norm(matched - uv[visible], axis=1) / np.hypot(height, width)
        hits[visible] += error <= FOUND
        shown[visible] += 1
    return hits / np.maximum(shown, 1), shown


def spread_out(points: Float[ndarray, "n 3"], share_found: Float[ndarray, "n"], n: int) -> Int[ndarray, "k"]:
    """Indices of at most n points: farthest-point sampling among those re-found most often.

    The best 3 n points are candidates: enough to spread over an object, few enough to exclude its worst places.
    """
    order = np.argsort(-share_found, kind="stable")
    threshold = share_found[order[min(3 * n, len(order)) - 1]]
    pool = np.flatnonzero(share_found >= threshold)
    chosen = [int(pool[np.argmax(share_found[pool])])]
    nearest = np.linalg.norm(points - points[chosen[0]], axis=1)
    while len(chosen) < min(n, len(pool)):
        best = int(pool[np.argmax(nearest[pool])])
        chosen.append(best)
        nearest = np.minimum(nearest, np.linalg.norm(points - points[best], axis=1))
    return np.array(chosen)
