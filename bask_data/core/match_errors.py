"""Errors of matches against exact depth and cameras."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8
from numpy import ndarray

from bask_data.core.geometry import in_image, invert_rigid, project, transform, unproject

INTERPOLABLE = 0.02
"""Share by which the farthest of the four depths around a position may exceed the nearest for them to be of one
surface. Chosen; its sensitivity is in docs/benchmarks.md."""


def true_depth(
    depth: Float32[ndarray, "h w"], labels: UInt8[ndarray, "h w"], uv: Float[ndarray, "n 2"]
) -> Float[ndarray, "n"]:
    """z-depth of exact depth images at positions between pixels, metres; 0 where there is none, and outside the image.

    Bilinear in inverse depth, which is exact on planes, where the four pixels around show one surface of one body; else
    that of the nearest pixel.
    """
    height, width = depth.shape
    inside = in_image(uv, height, width)
    uv = np.where(inside[:, None], uv, 0.0)
    u, v = np.rint(uv).astype(np.int64).clip(0, [width - 1, height - 1]).T
    nearest = depth[v, u].astype(np.float64)
    u0, v0 = np.floor(uv).astype(np.int64).clip(0, [max(width - 2, 0), max(height - 2, 0)]).T
    u1, v1 = np.minimum(u0 + 1, width - 1), np.minimum(v0 + 1, height - 1)
    corners = (v0, u0), (v0, u1), (v1, u0), (v1, u1)
    around = np.stack([depth[corner] for corner in corners]).astype(np.float64)
    one_body = np.all([labels[corner] == labels[v, u] for corner in corners], axis=0)
    lowest, highest = around.min(axis=0), around.max(axis=0)
    smooth = one_body & (lowest > 0) & (highest <= (1 + INTERPOLABLE) * lowest)
    along_u, along_v = np.clip(uv - np.stack([u0, v0], axis=1), 0.0, 1.0).T
    weights = np.stack(
        [(1 - along_u) * (1 - along_v), along_u * (1 - along_v), (1 - along_u) * along_v, along_u * along_v]
    )
    between = 1.0 / (weights / np.where(smooth, around, 1.0)).sum(axis=0)
    return np.where(inside, np.where(smooth, between, nearest), 0.0)


@dataclass(frozen=True)
class TrueView:
    """Ground truth of one view.

    Args:
        depth: z-depth, metres; 0 where the ray hits nothing.
        labels: the body at each pixel.
    """

    depth: Float32[ndarray, "h w"]
    labels: UInt8[ndarray, "h w"]
    K: Float[ndarray, "3 3"]
    world_from_camera: Float[ndarray, "4 4"]


@dataclass(frozen=True)
class MatchErrors:
    """Errors of m matches. The true point is the one that the pixel of the first view shows."""

    error_px: Float[ndarray, "m"]
    """Pixels in the second view between the match and the true point; infinity where there is no true point, or it is
    behind the second camera."""
    depth: Float[ndarray, "m"]
    """z-depth of the true point in the second view, metres; NaN where there is none."""
    behind: Float[ndarray, "m"]
    """Metres by which the true point is behind the surface that the second view shows at the nearest pixel: hidden, if
    more than the slope of a surface explains. Minus infinity without a surface there, and outside the image."""

    def hidden(self, slack: tuple[float, float] = (0.02, 0.0)) -> Bool[ndarray, "m"]:
        """Matches whose true point is hidden in the second view: more than a + b z metres behind the surface there.

        Args:
            slack: (a, b); the default assumes a tabletop.
        """
        return self.behind > slack[0] + slack[1] * np.nan_to_num(self.depth)


def match_errors(
    uv_a: Float[ndarray, "m 2"],
    uv_b: Float[ndarray, "m 2"],
    a: TrueView,
    b: TrueView,
) -> MatchErrors:
    """Errors of matches by exact depth and exact cameras.

    Args:
        uv_a, uv_b: matched pixels of the two views.
    """
    z_a = true_depth(a.depth, a.labels, uv_a.astype(np.float64))
    points_b = transform(
        invert_rigid(b.world_from_camera) @ a.world_from_camera, unproject(uv_a.astype(np.float64), z_a, a.K)
    )
    points_b[z_a <= 0] = np.nan
    true_uv, z_b = project(points_b, b.K)
    error = np.linalg.norm(true_uv - uv_b, axis=1)
    inside = in_image(true_uv, *b.depth.shape)
    nearest = np.rint(np.where(inside[:, None], true_uv, 0.0)).astype(np.int64)
    # Rounding a position on the last half pixel may lead out of the image.
    u, v = nearest.clip(0, [b.depth.shape[1] - 1, b.depth.shape[0] - 1]).T
    shown = b.depth[v, u].astype(np.float64)
    behind = np.where(inside & (shown > 0), z_b - shown, -np.inf)
    return MatchErrors(np.where(np.isfinite(error), error, np.inf), z_b, behind)
