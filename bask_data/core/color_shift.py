"""Where colour lies against depth, by the colours that surface has in two views.

Depth of one frame, warped into another, says which pixels show the same surface. If depth lies on colour, the colours
there are alike; if colour is shifted against depth, they are alike that many pixels away. Poses must be right: a wrong
pose of the camera on its mount (hand-eye) looks like a shift, too.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8
from numpy import ndarray

from bask_data.core.compiled import compiled

WIDTH = 320
"""Width that images are compared at: a step of a shift is two pixels of 640."""

N_WARPED_POINTS = 1500
"""Points warped per pair. Sensitivity not measured."""

LEAST_SEEN_TWICE = 150
"""Points that must meet measured depth for a pair to say anything. Sensitivity not measured."""

MEETS = 0.02
"""Share of the depth within which warped and measured depth are of the same surface, as `tsdf` noise of sensors."""

DETAIL, CONTRAST = 6.0, 12.0
"""Radii, pixels of `WIDTH`, of what is taken out as light and shade, and of the contrast that is divided by."""

SMOOTHING = 1.5
"""Blur of the likeness over shifts, pixels of `WIDTH`: parallax and coarse poses make peaks of pairs differ by so much.
On eight recordings 0, 1.5 and 3 gave the same peaks."""


@dataclass(frozen=True)
class ColorView:
    """A frame prepared for comparison.

    Args:
        detail: brightness without light and shade, `WIDTH` wide.
        depth: metres, 0 = none; of large images every other pixel or fewer, about twice `WIDTH` wide.
        K: of this depth.
    """

    detail: Float32[ndarray, "k l"]
    depth: Float32[ndarray, "h w"]
    K: Float[ndarray, "3 3"]


def color_view(rgb: UInt8[ndarray, "h w 3"], depth: Float32[ndarray, "h w"], K: Float[ndarray, "3 3"]) -> ColorView:
    """A frame prepared for comparison; depth in metres."""
    height, width = depth.shape
    small = cv2.resize(rgb, (WIDTH, round(height * WIDTH / width)), interpolation=cv2.INTER_AREA)
    grey = cv2.GaussianBlur(cv2.cvtColor(small, cv2.COLOR_RGB2GRAY).astype(np.float32), (0, 0), 0.7)
    detail = grey - cv2.GaussianBlur(grey, (0, 0), DETAIL)
    contrast = np.sqrt(cv2.GaussianBlur(detail * detail, (0, 0), CONTRAST)) + 2
    step = max(1, width // (2 * WIDTH))
    K_thinned = K.copy()
    K_thinned[:2] /= step
    return ColorView((detail / contrast).astype(np.float32), np.ascontiguousarray(depth[::step, ::step]), K_thinned)


def likeness(a: ColorView, b: ColorView, b_from_a: Float[ndarray, "4 4"], reach: int) -> Float32[ndarray, "n n"] | None:
    """Correlation of colours of the same surface in two views, above its median over shifts, for each shift of colour.

    Args:
        b_from_a: motion of the camera, metres.
        reach: largest shift (u, v), pixels of `WIDTH`; the result is indexed [v, u] from -reach.

    Returns:
        None if too little surface is seen by both.
    """
    v, u = np.nonzero(a.depth > 0)
    if len(u) < LEAST_SEEN_TWICE:
        return None
    chosen = np.unique(np.linspace(0, len(u) - 1, N_WARPED_POINTS).astype(int))
    uv = np.stack([u[chosen], v[chosen]], axis=1).astype(np.float64)
    z = a.depth[v[chosen], u[chosen]].astype(np.float64)
    there = _landing(uv, z, a.K, b.K, b_from_a, b.depth, MEETS)
    met = there[:, 0] >= 0
    if met.sum() < LEAST_SEEN_TWICE:
        return None
    to_small = WIDTH / a.depth.shape[1]
    at_a, at_b = ((points[met] + 0.5) * to_small - 0.5 for points in (uv, there))
    scores = _correlations(at_a, at_b, a.detail, b.detail, reach)
    return cv2.GaussianBlur((scores - np.median(scores)).astype(np.float32), (0, 0), SMOOTHING)


@compiled
def _landing(
    uv: ndarray, z: ndarray, K_a: ndarray, K_b: ndarray, b_from_a: ndarray, depth_b: ndarray, share: float
) -> ndarray:
    """Where points land in b, pixels; -1 where b does not measure them."""
    height, width = depth_b.shape
    there = np.full((len(uv), 2), -1.0)
    for i in range(len(uv)):
        p0 = (uv[i, 0] - K_a[0, 2]) / K_a[0, 0] * z[i]
        p1 = (uv[i, 1] - K_a[1, 2]) / K_a[1, 1] * z[i]
        q0 = b_from_a[0, 0] * p0 + b_from_a[0, 1] * p1 + b_from_a[0, 2] * z[i] + b_from_a[0, 3]
        q1 = b_from_a[1, 0] * p0 + b_from_a[1, 1] * p1 + b_from_a[1, 2] * z[i] + b_from_a[1, 3]
        q2 = b_from_a[2, 0] * p0 + b_from_a[2, 1] * p1 + b_from_a[2, 2] * z[i] + b_from_a[2, 3]
        if q2 <= 1e-9:
            continue
        u, v = K_b[0, 0] * q0 / q2 + K_b[0, 2], K_b[1, 1] * q1 / q2 + K_b[1, 2]
        column, row = int(np.floor(u + 0.5)), int(np.floor(v + 0.5))
        if column < 0 or row < 0 or column >= width or row >= height:
            continue
        if abs(depth_b[row, column] - q2) <= share * depth_b[row, column]:
            there[i, 0], there[i, 1] = u, v
    return there


@compiled
def _correlations(at_a: ndarray, at_b: ndarray, image_a: ndarray, image_b: ndarray, reach: int) -> ndarray:
    """Correlation of two images at pairs of points, both shifted alike; [v, u]."""
    height, width = image_a.shape
    height_b, width_b = image_b.shape
    side = 2 * reach + 1
    scores = np.zeros((side, side))
    for k in range(side * side):
        du, dv = k % side - reach, k // side - reach
        n, sum_a, sum_b, sum_aa, sum_bb, sum_ab = 0, 0.0, 0.0, 0.0, 0.0, 0.0
        for i in range(len(at_a)):
            u_a, v_a = int(np.floor(at_a[i, 0] + du + 0.5)), int(np.floor(at_a[i, 1] + dv + 0.5))
            u_b, v_b = int(np.floor(at_b[i, 0] + du + 0.5)), int(np.floor(at_b[i, 1] + dv + 0.5))
            if min(u_a, v_a, u_b, v_b) < 0 or u_a >= width or v_a >= height or u_b >= width_b or v_b >= height_b:
                continue
            a, b = image_a[v_a, u_a], image_b[v_b, u_b]
            n += 1
            sum_a += a
            sum_b += b
            sum_aa += a * a
            sum_bb += b * b
            sum_ab += a * b
        if n < len(at_a) // 3:
            continue
        spread = (sum_aa / n - (sum_a / n) ** 2) * (sum_bb / n - (sum_b / n) ** 2)
        if spread > 0:
            scores[dv + reach, du + reach] = (sum_ab / n - sum_a * sum_b / n / n) / np.sqrt(spread)
    return scores
