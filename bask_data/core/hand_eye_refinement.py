"""One rigid correction of all poses of a camera: an error of the hand-eye calibration.

Given poses contain a constant error E: true world_from_camera = given @ E. Depth of frames that overlap meets only
under the right E, if the camera turns between them about several axes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from bask_data.core.compiled import compiled
from bask_data.core.depth import SIGMA_FROM_MAD
from bask_data.core.geometry import invert_rigid
from bask_data.core.pair_alignment import FINEST, STEPS_PER_GATE, TUKEY, as_vector, moved
from bask_data.core.surface_views import SurfaceView

HAND_EYE_GATES = (0.08, 0.05, 0.03, 0.02, 0.012)
"""Distances, metres, within which points that meet may belong together, coarse to fine: an error of 20 mm and 4 degrees
moves points at 0.5 m by up to 55 mm. Sensitivity not measured."""

CONVERGED = 2e-5
"""Radians and metres: a smaller step is the last one at a gate."""

PRIOR = np.repeat([0.1, 0.2], 3)
"""Standard deviations of a correction before any depth is seen, radians and metres: wide against errors of
calibrations, they keep at zero what depth does not determine. Sensitivity not measured."""

SCALE_ERROR = 0.005
"""Error of the depth's scale, a share, that an error of the poses is told with: the better half of what data sheets of
RGB-D cameras state."""

N_GROUPS = 8
"""Groups of successive frames, each left out in turn to see how the correction varies."""


@dataclass(frozen=True)
class Correction:
    """A correction with its uncertainty.

    Args:
        given_from_true: E, camera frame: true world_from_camera = given @ E.
        deviation_rad, deviation_m: standard deviations along the least certain axis of rotation and translation.
        residual: robust standard deviation of the points that meet, metres.
        of_scale_m: translation, metres, that depth wrong in scale by `SCALE_ERROR` would look like.
    """

    given_from_true: Float[ndarray, "4 4"]
    deviation_rad: float
    deviation_m: float
    residual: float
    of_scale_m: float


def hand_eye(
    views: Sequence[SurfaceView],
    world_from_cameras: Float[ndarray, "t 4 4"],
    pairs: Sequence[tuple[int, int]],
) -> Correction:
    """The constant error of the given poses, by point-to-plane distances over pairs of views.

    Args:
        pairs: indices of views that overlap.
    """
    E, sigma = np.eye(4), HAND_EYE_GATES[0] / 3
    for gate in HAND_EYE_GATES:
        for _ in range(STEPS_PER_GATE):
            equations = _equations(views, world_from_cameras, pairs, E, gate, sigma)
            step = _solved(equations.H.sum(axis=0), equations.g.sum(axis=0), as_vector(E))
            E, sigma = moved(step) @ E, equations.sigma
            if np.abs(step).max() < CONVERGED:
                break
    equations = _equations(views, world_from_cameras, pairs, E, HAND_EYE_GATES[-1], sigma)
    covariance = _covariance(equations, pairs, len(views))
    turn, shift = (np.sqrt(np.linalg.eigvalsh(covariance[part, part])[-1]) for part in (slice(3), slice(3, 6)))
    H = equations.H.sum(axis=0)
    passed_on = np.linalg.solve(H[:6, :6] + np.diag(PRIOR**-2), H[:6, 6]) * SCALE_ERROR
    return Correction(E, float(turn), float(shift), equations.sigma, float(np.linalg.norm(passed_on[3:])))


def _solved(H: Float[ndarray, "8 8"], g: Float[ndarray, "8"], state: Float[ndarray, "6"]) -> Float[ndarray, "6"]:
    return np.linalg.solve(H[:6, :6] + np.diag(PRIOR**-2), -g[:6] - PRIOR**-2 * state)


@dataclass(frozen=True)
class _Equations:
    """Normal equations of each pair for a step, and for scale and offset of the depth; the robust standard deviation of
    the residuals, metres."""

    H: Float[ndarray, "p 8 8"]
    g: Float[ndarray, "p 8"]
    sigma: float


def _equations(
    views: Sequence[SurfaceView],
    world_from_cameras: Float[ndarray, "t 4 4"],
    pairs: Sequence[tuple[int, int]],
    E: Float[ndarray, "4 4"],
    gate: float,
    sigma: float,
) -> _Equations:
    """Equations for a step that is applied before E, weighted by residuals relative to `sigma`."""
    H, g, residuals = np.zeros((len(pairs), 8, 8)), np.zeros((len(pairs), 8)), []
    for k, (i, j) in enumerate(pairs):
        for a, b in ((views[i], views[j]), (views[j], views[i])):
            a_from_b = invert_rigid(world_from_cameras[i if a is views[i] else j])
            a_from_b = a_from_b @ world_from_cameras[j if a is views[i] else i]
            residuals.append(
                _accumulated(H[k], g[k], a.points, a.normals, b.depth, b.K, a_from_b, E, gate, TUKEY * sigma)
            )
    everything = np.concatenate(residuals)
    sigma = max(SIGMA_FROM_MAD * float(np.median(np.abs(everything))), FINEST) if len(everything) else gate / 3
    return _Equations(H / sigma**2, g / sigma**2, sigma)


def _covariance(equations: _Equations, pairs: Sequence[tuple[int, int]], n_views: int) -> Float[ndarray, "6 6"]:
    """Covariance of a correction: the inverse of the normal equations; the spread when groups of frames are left out,
    as points of a frame share errors."""
    H = equations.H.sum(axis=0)
    formal = np.linalg.inv(H[:6, :6] + np.diag(PRIOR**-2))
    group = np.array(pairs) * N_GROUPS // n_views
    steps = []
    for k in range(N_GROUPS):
        kept = (group != k).all(axis=1)
        if kept.any():
            steps.append(_solved(equations.H[kept].sum(axis=0), equations.g[kept].sum(axis=0), np.zeros(6)))
    spread = np.array(steps) - np.mean(steps, axis=0)
    jackknife = (len(steps) - 1) / max(len(steps), 1) * spread.T @ spread
    return np.asarray(formal + jackknife)


@compiled
def _accumulated(H, g, points, normals, depth, K, G, E, gate, cut):  # type: ignore[no-untyped-def]
    """Add the equations of points of view a that meet the depth of view b; returns the residuals within the gate.

    A residual is the distance of a point from the one measured in b, along a's normal, in the frame of a's given pose.

    Args:
        G: a_from_b of the given poses.
    """
    height, width = depth.shape
    residuals, n_in = np.zeros(len(points)), 0
    J, p, ray, apart = np.zeros(8), np.zeros(3), np.zeros(3), np.zeros(3)
    x_a, x_b, n, n_b = np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3)
    for i in range(len(points)):
        for k in range(3):
            x_a[k] = E[k, 0] * points[i, 0] + E[k, 1] * points[i, 1] + E[k, 2] * points[i, 2] + E[k, 3]
            n[k] = E[k, 0] * normals[i, 0] + E[k, 1] * normals[i, 1] + E[k, 2] * normals[i, 2]
        for k in range(3):
            apart[k] = x_a[k] - G[k, 3]
        for k in range(3):
            x_b[k] = G[0, k] * apart[0] + G[1, k] * apart[1] + G[2, k] * apart[2] - E[k, 3]
            n_b[k] = G[0, k] * n[0] + G[1, k] * n[1] + G[2, k] * n[2]
        for k in range(3):
            p[k] = E[0, k] * x_b[0] + E[1, k] * x_b[1] + E[2, k] * x_b[2]
        if p[2] <= 1e-9:
            continue
        u = int(np.floor(K[0, 0] * p[0] / p[2] + K[0, 2] + 0.5))
        v = int(np.floor(K[1, 1] * p[1] / p[2] + K[1, 2] + 0.5))
        if u < 0 or v < 0 or u >= width or v >= height or depth[v, u] <= 0:
            continue
        z = depth[v, u]
        ray[0], ray[1], ray[2] = (u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], 1.0
        for k in range(3):
            x_b[k] = (E[k, 0] * ray[0] + E[k, 1] * ray[1] + E[k, 2] * ray[2]) * z + E[k, 3]
        r, square = 0.0, 0.0
        for k in range(3):
            apart[k] = x_a[k] - (G[k, 0] * x_b[0] + G[k, 1] * x_b[1] + G[k, 2] * x_b[2] + G[k, 3])
            r += n[k] * apart[k]
            square += apart[k] * apart[k]
        if abs(r) > gate or square > 4 * gate * gate:
            continue
        residuals[n_in] = r
        n_in += 1
        if abs(r) >= cut:
            continue
        weight = (1 - (r / cut) ** 2) ** 2
        for k in range(3):
            f, s = (k + 1) % 3, (k + 2) % 3
            J[k] = x_a[f] * n[s] - x_a[s] * n[f] - (x_b[f] * n_b[s] - x_b[s] * n_b[f])
            J[k] += n[f] * apart[s] - n[s] * apart[f]
            J[3 + k] = n[k] - n_b[k]
        J[6], J[7] = 0.0, 0.0
        for k in range(3):
            seen_a, seen_b = x_a[k] - E[k, 3], x_b[k] - E[k, 3]
            J[6] += n[k] * seen_a - n_b[k] * seen_b
            J[7] += n[k] * seen_a / points[i, 2] - n_b[k] * seen_b / z
        for j in range(8):
            g[j] += weight * r * J[j]
            for k in range(8):
                H[j, k] += weight * J[j] * J[k]
    return residuals[:n_in]
