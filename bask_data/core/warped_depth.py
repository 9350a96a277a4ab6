"""Evidence for a reading of poses, depth and clock: depth of one frame, warped into another, meets what was measured.

A pair's evidence is the share of warped points that meet the measured depth, averaged over tolerances, so that no noise
level need be chosen. Readings are compared pair by pair.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Int
from numpy import ndarray

from bask_data.core.compiled import compiled

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

    def thinned(self, step: int) -> DepthView:
        """The view with every so many points only."""
        return DepthView(self.depth, self.K, self.uv[::step], self.z[::step])


@dataclass(frozen=True)
class Warps:
    """Ways to warp points of one frame into another, one in each row.

    Args:
        transform: which of the pair's motions.
        shrink: factor of the motion's translation; 0 leaves the rotation only.
        K_factor: of intrinsics along u and v, about the corner of the pixel grid.
        ray: what depth values are: 0 z, 1 lengths of the ray, -1 z that was divided by the ray's length.
    """

    transform: Int[ndarray, " h"]
    shrink: Float[ndarray, " h"]
    K_factor: Float[ndarray, "h 2"]
    ray: Int[ndarray, " h"]


def depth_view(depth: Float32[ndarray, "h w"], K: Float[ndarray, "3 3"], n_points: int) -> DepthView:
    """A frame's depth with some of its points, spread evenly over what was measured."""
    measured = np.flatnonzero(depth > 0)
    chosen = measured[np.unique(np.linspace(0, len(measured) - 1, n_points).astype(int))] if len(measured) else measured
    v, u = np.unravel_index(chosen, depth.shape)
    uv = np.stack([u, v], axis=1).astype(np.int64)
    return DepthView(np.ascontiguousarray(depth), K, uv, depth[v, u].astype(np.float64))


def evidence_of(
    a: DepthView, b: DepthView, b_from_as: Float[ndarray, "m 4 4"], warps: Warps
) -> tuple[Float[ndarray, " h"], Float[ndarray, " h"]]:
    """Evidence of a pair in [0, 1] for each way to warp, and the share of points that fall onto measured depth.

    Args:
        b_from_as: motions of the camera that `warps` choose from, metres.
    """
    return _evidence_of(
        a.uv,
        a.z,
        b.depth,
        np.ascontiguousarray(a.K, np.float64),
        np.ascontiguousarray(b.K, np.float64),
        np.ascontiguousarray(b_from_as, np.float64),
        (warps.transform, warps.shrink, warps.K_factor, warps.ray),
        np.array(sorted(TOLERANCES, reverse=True)),
        MIN_MEASURED,
    )


def evidence(
    a: DepthView, b: DepthView, b_from_a: Float[ndarray, "4 4"], scale: float = 1.0, is_ray: bool = False
) -> float:
    """Evidence of a pair in [0, 1] for a reading.

    Args:
        b_from_a: the camera's motion under the reading, metres.
        scale: metres under the reading per metre as read.
        is_ray: whether depth is the length of the ray, not z.
    """
    warps = Warps(np.zeros(1, np.int64), np.array([1 / scale]), np.ones((1, 2)), np.array([int(is_ray)]))
    return float(evidence_of(a, b, b_from_a[None], warps)[0][0])


@compiled
def _evidence_of(
    uv: ndarray,
    z: ndarray,
    depth_b: ndarray,
    K_a: ndarray,
    K_b: ndarray,
    motions: ndarray,
    warps: tuple[ndarray, ndarray, ndarray, ndarray],
    tolerances: ndarray,
    least: float,
) -> tuple[ndarray, ndarray]:
    transform, shrink, K_factor, ray = warps
    height, width = depth_b.shape
    met, seen = np.zeros(len(transform)), np.zeros(len(transform))
    for h in range(len(transform)):
        M, s, kx, ky, kind = motions[transform[h]], shrink[h], K_factor[h, 0], K_factor[h, 1], ray[h]
        fx_a, fy_a, fx, fy = K_a[0, 0] * kx, K_a[1, 1] * ky, K_b[0, 0] * kx, K_b[1, 1] * ky
        cx_a, cy_a = (K_a[0, 2] + 0.5) * kx - 0.5, (K_a[1, 2] + 0.5) * ky - 0.5
        cx, cy = (K_b[0, 2] + 0.5) * kx - 0.5, (K_b[1, 2] + 0.5) * ky - 0.5
        n_measured, n_met = 0, 0
        for i in range(len(z)):
            x, y, z_a = (uv[i, 0] - cx_a) / fx_a, (uv[i, 1] - cy_a) / fy_a, z[i]
            if kind != 0:
                z_a *= (1 + x * x + y * y) ** (-0.5 * kind)
            q0 = z_a * (M[0, 0] * x + M[0, 1] * y + M[0, 2]) + s * M[0, 3]
            q1 = z_a * (M[1, 0] * x + M[1, 1] * y + M[1, 2]) + s * M[1, 3]
            q2 = z_a * (M[2, 0] * x + M[2, 1] * y + M[2, 2]) + s * M[2, 3]
            if q2 <= 1e-9:
                continue
            u, v = fx * q0 / q2 + cx + 0.5, fy * q1 / q2 + cy + 0.5
            if not (0 <= u < width and 0 <= v < height):
                continue
            there = depth_b[int(v), int(u)]
            if there <= 0:
                continue
            n_measured += 1
            if kind != 0:
                q2 *= (1 + (q0 * q0 + q1 * q1) / (q2 * q2)) ** (0.5 * kind)
            error = abs(q2 - there)
            for t in tolerances:
                if error >= t * there:
                    break
                n_met += 1
        if n_measured > 0:
            seen[h] = n_measured / len(z)
        if n_measured > 0 and n_measured >= least * len(z):
            met[h] = n_met / (n_measured * len(tolerances))
    return met, seen
