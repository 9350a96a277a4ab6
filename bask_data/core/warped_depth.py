"""Evidence for a reading of poses, depth and clock: depth of one frame, warped into another, meets what was measured.

A pair's evidence is the share of warped points that meet the measured depth, averaged over tolerances, so that no noise
level need be chosen. Readings are compared pair by pair.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from jaxtyping import Float, Float32, Int
from numpy import ndarray

TOLERANCES = (0.0025, 0.005, 0.01, 0.02, 0.04, 0.08)
"""Shares of the depth within which depths count as equal: from a good sensor's noise to a bad one's at the edge of its
range. Sensitivity not measured."""

MIN_MEASURED = 0.15
"""Least share of a frame's points that must fall onto measured depth for a pair to say anything; fewer is no evidence
for the reading. Sensitivity not measured."""


@dataclass(frozen=True)
class DepthView:
    """Depth of a frame and the points taken from it.

    Args:
        depth: metres, 0 = none.
        uv: pixels of the points.
        z: their depth, metres.
    """

    depth: Float32[ndarray, "h w"]
    K: Float[ndarray, "3 3"]
    uv: Int[ndarray, "n 2"]
    z: Float[ndarray, " n"]


def depth_view(depth: Float32[ndarray, "h w"], K: Float[ndarray, "3 3"], n_points: int) -> DepthView:
    """A frame's depth with some of its points, spread evenly over what was measured."""
    v, u = np.nonzero(depth > 0)
    chosen = np.unique(np.linspace(0, len(u) - 1, n_points).astype(int)) if len(u) else np.zeros(0, int)
    uv = np.stack([u[chosen], v[chosen]], axis=1).astype(np.int64)
    return DepthView(np.ascontiguousarray(depth), K, uv, depth[uv[:, 1], uv[:, 0]].astype(np.float64))


def evidence(
    a: DepthView, b: DepthView, b_from_a: Float[ndarray, "4 4"], scale: float = 1.0, is_ray: bool = False
) -> float:
    """Evidence of a pair in [0, 1] for a reading.

    Args:
        b_from_a: the camera's motion under the reading, metres.
        scale: metres under the reading per metre as read.
        is_ray: whether depth is the length of the ray, not z.
    """
    return float(
        _evidence(a.uv, a.z * scale, b.depth, scale, a.K, b.K, b_from_a, is_ray, np.array(TOLERANCES), MIN_MEASURED)
    )


@numba.njit(cache=True)
def _evidence(
    uv: ndarray,
    z: ndarray,
    depth_b: ndarray,
    scale: float,
    K_a: ndarray,
    K_b: ndarray,
    b_from_a: ndarray,
    is_ray: bool,
    tolerances: ndarray,
    least: float,
) -> float:
    height, width = depth_b.shape
    n_measured, met = 0, 0.0
    for i in range(len(z)):
        y = (uv[i, 1] - K_a[1, 2]) / K_a[1, 1]
        x = (uv[i, 0] - K_a[0, 2]) / K_a[0, 0]
        z_a = z[i] / np.sqrt(1 + x * x + y * y) if is_ray else z[i]
        p0, p1, p2 = x * z_a, y * z_a, z_a
        q0 = b_from_a[0, 0] * p0 + b_from_a[0, 1] * p1 + b_from_a[0, 2] * p2 + b_from_a[0, 3]
        q1 = b_from_a[1, 0] * p0 + b_from_a[1, 1] * p1 + b_from_a[1, 2] * p2 + b_from_a[1, 3]
        q2 = b_from_a[2, 0] * p0 + b_from_a[2, 1] * p1 + b_from_a[2, 2] * p2 + b_from_a[2, 3]
        if q2 <= 1e-9:
            continue
        u = int(np.floor(K_b[0, 0] * q0 / q2 + K_b[0, 2] + 0.5))
        v = int(np.floor(K_b[1, 1] * q1 / q2 + K_b[1, 2] + 0.5))
        if u < 0 or v < 0 or u >= width or v >= height or depth_b[v, u] <= 0:
            continue
        n_measured += 1
        there = depth_b[v, u] * scale
        expected = np.sqrt(q0 * q0 + q1 * q1 + q2 * q2) if is_ray else q2
        error = abs(expected - there) / there
        for t in tolerances:
            met += error < t
    if n_measured < least * len(z) or n_measured == 0:
        return 0.0
    return met / (n_measured * len(tolerances))
