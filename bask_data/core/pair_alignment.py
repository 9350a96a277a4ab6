"""Two views brought together by their depth alone, from a first guess."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float
from numpy import ndarray

from bask_data.core.depth import SIGMA_FROM_MAD
from bask_data.core.surface_views import SurfaceView, meetings

PAIR_GATES = (0.06, 0.03, 0.015, 0.01)
"""Distances, metres, within which points that meet may belong together, coarse to fine. Sensitivity not measured."""

STEPS_PER_GATE = 4
"""Most steps of Gauss-Newton at each gate. Sensitivity not measured."""

TUKEY = 4.685
"""Residuals of so many standard deviations have no weight: 95 % efficiency on normal noise. Source: Huber 1981."""

FINEST = 1e-4
"""Least standard deviation of residuals, metres: exact depth would give points no weight."""

GUESS = np.repeat([np.radians(2.0), 0.02], 3)
"""Standard deviations of the first guess, radians and metres: it stays where depth determines nothing, such as sliding
along a table. Sensitivity not measured."""

LEAST_MET = 100
"""Points that must meet; with fewer, the guess is kept. Sensitivity not measured."""

MOST_RESIDUAL = 0.02
"""Distance, metres, from which on points count as equally far apart: they may be of other surfaces. Sensitivity not
measured."""


@dataclass(frozen=True)
class PairAlignment:
    """The motion between two views that makes their depth meet.

    Args:
        information: inverse covariance, times the variance of a point, of a step in a's frame: rotation, then
            translation.
        is_measured: whether enough points met to say anything.
    """

    b_from_a: Float[ndarray, "4 4"]
    information: Float[ndarray, "6 6"]
    is_measured: bool


def moved(vector: Float[ndarray, "6"]) -> Float[ndarray, "4 4"]:
    """The transform of a rotation vector, radians, and a translation, metres."""
    made = np.eye(4)
    made[:3, :3] = cv2.Rodrigues(np.ascontiguousarray(vector[:3]))[0]
    made[:3, 3] = vector[3:]
    return made


def as_vector(transform: Float[ndarray, "4 4"]) -> Float[ndarray, "6"]:
    """The rotation vector, radians, and the translation, metres, of a transform."""
    return np.concatenate([cv2.Rodrigues(np.ascontiguousarray(transform[:3, :3]))[0].ravel(), transform[:3, 3]])


def aligned(a: SurfaceView, b: SurfaceView, b_from_a: Float[ndarray, "4 4"]) -> PairAlignment:
    """The views brought together by point-to-plane distances (ICP with projective association).

    Args:
        b_from_a: the first guess, within some 20 mm and 3 degrees.
    """
    guess, change, sigma, n_met = b_from_a, np.eye(4), PAIR_GATES[0] / 3, 0
    prior = np.diag(GUESS**-2)
    H = np.zeros((6, 6))
    for gate in PAIR_GATES:
        for _ in range(STEPS_PER_GATE):
            met = meetings(a, b, guess @ change)
            r, J = _rows(met.points_a, met.normals_a, met.points_b, guess @ change)
            near = np.abs(r) < gate
            r, J, n_met = r[near], J[near], int(near.sum())
            if n_met < LEAST_MET:
                return PairAlignment(guess, prior * FINEST**2, False)
            sigma = max(SIGMA_FROM_MAD * float(np.median(np.abs(r))), FINEST)
            share = r / (TUKEY * sigma)
            weights = np.where(np.abs(share) < 1, (1 - share**2) ** 2, 0.0)
            H = (J * weights[:, None]).T @ J
            # Points share errors: one in ten counts against the guess.
            step = np.linalg.solve(
                H / sigma**2 / 10 + prior, -(J.T @ (weights * r)) / sigma**2 / 10 - prior @ as_vector(change)
            )
            change = change @ moved(step)
            if np.abs(step).max() < 2e-5:
                break
    return PairAlignment(guess @ change, H + 10 * sigma**2 * prior, True)


def _rows(
    points_a: Float[ndarray, "n 3"],
    normals_a: Float[ndarray, "n 3"],
    points_b: Float[ndarray, "n 3"],
    b_from_a: Float[ndarray, "4 4"],
) -> tuple[Float[ndarray, " n"], Float[ndarray, "n 6"]]:
    """Residuals along a's normals, metres, and their derivatives by a step in a's frame."""
    there = (points_b - b_from_a[:3, 3]) @ b_from_a[:3, :3]
    J = np.empty((len(points_a), 6))
    for k in range(3):  # Three times as fast as np.cross.
        i, j = (k + 1) % 3, (k + 2) % 3
        J[:, k] = points_a[:, i] * normals_a[:, j] - points_a[:, j] * normals_a[:, i]
    J[:, 3:] = normals_a
    return np.einsum("ij,ij->i", normals_a, points_a - there), J


def residual(a: SurfaceView, b: SurfaceView, b_from_a: Float[ndarray, "4 4"]) -> float:
    """Mean distance, metres, of points of both views from the surface of the other, at most `MOST_RESIDUAL` each; NaN
    where too few meet."""
    inverse = np.linalg.inv(b_from_a)
    distances = []
    for first, second, motion in ((a, b, b_from_a), (b, a, inverse)):
        met = meetings(first, second, motion)
        distances.append(np.abs(_rows(met.points_a, met.normals_a, met.points_b, motion)[0]))
    everything = np.minimum(np.concatenate(distances), MOST_RESIDUAL)
    return float(everything.mean()) if len(everything) >= LEAST_MET else float("nan")
