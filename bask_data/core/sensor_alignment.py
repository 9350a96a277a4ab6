"""How far the surface of one frame lies from that of another, and the rigid correction that would mend it."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float
from numpy import ndarray

from bask_data.core.compiled import compiled
from bask_data.core.depth import SIGMA_FROM_MAD
from bask_data.core.geometry import invert_rigid, rotation_angle, transform
from bask_data.core.sensor_frames import BlockPoints

N_ALIGNED = 1000
"""Points of a frame that are compared with another. Sensitivity not measured."""

GATES = (0.1, 0.05, 0.025, 0.02, 0.02)
"""Largest distances of surfaces that are compared, relative to depth, step by step. Sensitivity not measured."""

SAME_FACING = 0.7
"""Least cosine between normals of one surface. Sensitivity not measured."""

LEAST_COMPARED = 150
"""Fewest points that a correction is estimated from. Sensitivity not measured."""

PRIOR = 0.003
"""Weight of no correction, relative to the mean over directions of what the points say, so that a direction that they
do not determine stays as it is: along a single plane. Sensitivity not measured."""


DARK, BRIGHT = 8.0, 247.0
"""Grey levels beyond which a pixel is clipped and says nothing of exposure."""


@dataclass(frozen=True)
class Alignment:
    """What the surfaces of two frames say about the motion between them.

    Args:
        moved: metres by which the correction moves the surface along its normals, root mean square: what is seen of an
            error of the poses. Along a plane nothing is seen.
        shift, angle: of the correction, metres at the middle of the points, and radians.
        before, after: median distance of the surfaces, metres, as given and corrected.
        overlap: share of the points that are compared: that land on a measured surface facing the same way.
        agree: share of the points landing on a measurement that lie within 2 % of it, corrected.
        depth: median of the compared points, metres.
        gain: logarithm of the second frame's grey level relative to the first's, median over the points.
    """

    moved: float
    shift: float
    angle: float
    before: float
    after: float
    overlap: float
    agree: float
    depth: float
    gain: float


def aligned(a: BlockPoints, b: BlockPoints, b_from_a: Float[ndarray, "4 4"]) -> Alignment | None:
    """The correction of a motion that brings the surface of one frame onto that of another, point to plane.

    Args:
        b_from_a: the motion as the poses have it, metres.

    Returns:
        None if too few points of the surface are seen by both.
    """
    known = np.flatnonzero(np.isfinite(a.normals[..., 0]).ravel())
    if len(known) < LEAST_COMPARED:
        return None
    known = known[np.unique(np.linspace(0, len(known) - 1, N_ALIGNED).astype(int))]
    points_a = a.points.reshape(-1, 3)[known].astype(np.float64)
    normals_a = a.normals.reshape(-1, 3)[known].astype(np.float64)
    target = (b.points, b.normals, b.K, b.step)
    corrected = np.array(b_from_a, np.float64)
    before = after = float("nan")
    start = points_a[:0]
    for i_step, gate in enumerate((*GATES, GATES[-1])):
        block, distance, q, n, n_landed = _compared(points_a, normals_a, *target, corrected, gate, SAME_FACING)
        near = np.flatnonzero(block >= 0)
        if len(near) < LEAST_COMPARED:
            return None
        x, n = q[near], n[near]
        after = float(np.median(np.abs(distance[near])))
        if i_step == 0:
            before, start = after, x
        if i_step < len(GATES):
            corrected = _step(x, n, distance[near], 4 * SIGMA_FROM_MAD * after + 1e-9) @ corrected
    correction = corrected @ invert_rigid(b_from_a)
    change = x - transform(invert_rigid(correction), x)
    grey_a, grey_b = a.grey.ravel()[known][near], b.grey.ravel()[block[near]]
    lit = (np.minimum(grey_a, grey_b) > DARK) & (np.maximum(grey_a, grey_b) < BRIGHT)
    return Alignment(
        moved=float(np.sqrt(np.mean(np.einsum("ni,ni->n", change, n) ** 2))),
        shift=float(np.linalg.norm((transform(correction, start) - start).mean(axis=0))),
        angle=float(rotation_angle(correction[:3, :3])),
        before=before,
        after=after,
        overlap=len(near) / len(known),
        agree=len(near) / max(1, n_landed),
        depth=float(np.median(x[:, 2])),
        gain=float(np.median(np.log(grey_b[lit] / grey_a[lit]))) if lit.sum() >= LEAST_COMPARED else float("nan"),
    )


@compiled
def _compared(
    points_a: ndarray,
    normals_a: ndarray,
    points_b: ndarray,
    normals_b: ndarray,
    K: ndarray,
    step: int,
    b_from_a: ndarray,
    gate: float,
    same_facing: float,
) -> tuple[ndarray, ndarray, ndarray, ndarray, int]:
    """The block of `b` each point is compared with, or -1; its distance from the surface there, itself and the normal,
    both in frame b; and the number of points that land on a measured surface."""
    rows, columns = points_b.shape[:2]
    count = len(points_a)
    block, distance = np.full(count, -1, np.int64), np.zeros(count)
    q, n = np.zeros((count, 3)), np.zeros((count, 3))
    n_landed = 0
    for i in range(count):
        for k in range(3):
            q[i, k] = b_from_a[k, 3]
            for m in range(3):
                q[i, k] += b_from_a[k, m] * points_a[i, m]
        if q[i, 2] <= 1e-6:
            continue
        u = (K[0, 0] * q[i, 0] + K[0, 1] * q[i, 1]) / q[i, 2] + K[0, 2]
        v = K[1, 1] * q[i, 1] / q[i, 2] + K[1, 2]
        column, row = np.floor((u + 0.5) / step), np.floor((v + 0.5) / step)
        if column < 0 or row < 0 or column >= columns or row >= rows:
            continue
        c, r = int(column), int(row)
        if np.isnan(normals_b[r, c, 0]):
            continue
        n_landed += 1
        facing = 0.0
        for k in range(3):
            n[i, k] = normals_b[r, c, k]
            distance[i] += n[i, k] * (q[i, k] - points_b[r, c, k])
            turned = 0.0
            for m in range(3):
                turned += b_from_a[k, m] * normals_a[i, m]
            facing += n[i, k] * turned
        if abs(distance[i]) < gate * q[i, 2] and facing > same_facing:
            block[i] = r * columns + c
    return block, distance, q, n, n_landed


def _step(x: ndarray, n: ndarray, r: ndarray, reach: float) -> ndarray:
    """The small rigid motion that reduces the distances most.

    Args:
        x, n, r: points and normals (n, 3), and distances (n,). Not checked by type: it runs hundreds of times.
        reach: distance from which a point has no weight, metres.
    """
    centre, size, normal, right = _equations(x, n, r, reach)
    normal += PRIOR * np.trace(normal) / 6 * np.eye(6)
    solution = -np.linalg.solve(normal, right)
    motion = np.eye(4)
    motion[:3, :3] = cv2.Rodrigues(solution[:3] / size)[0]
    motion[:3, 3] = centre + solution[3:] - motion[:3, :3] @ centre
    return motion


@compiled
def _equations(x: ndarray, n: ndarray, r: ndarray, reach: float) -> tuple[ndarray, float, ndarray, ndarray]:
    """The normal equations of point to plane with Tukey's weights: about which centre they turn, the metres that a
    turn is counted in, so that all six unknowns weigh alike, the matrix and the right side."""
    count = len(r)
    weight = np.zeros(count)
    centre, total = np.zeros(3), 1e-12
    for i in range(count):
        weight[i] = max(0.0, 1 - (r[i] / reach) ** 2) ** 2
        total += weight[i]
        for k in range(3):
            centre[k] += weight[i] * x[i, k]
    centre /= total
    square = 0.0
    for i in range(count):
        for k in range(3):
            square += weight[i] * (x[i, k] - centre[k]) ** 2
    size = np.sqrt(square / total) + 1e-9
    normal, right, row = np.zeros((6, 6)), np.zeros(6), np.zeros(6)
    for i in range(count):
        if weight[i] == 0:
            continue
        a0, a1, a2 = (x[i, 0] - centre[0]) / size, (x[i, 1] - centre[1]) / size, (x[i, 2] - centre[2]) / size
        row[0] = a1 * n[i, 2] - a2 * n[i, 1]
        row[1] = a2 * n[i, 0] - a0 * n[i, 2]
        row[2] = a0 * n[i, 1] - a1 * n[i, 0]
        row[3], row[4], row[5] = n[i, 0], n[i, 1], n[i, 2]
        for k in range(6):
            right[k] += weight[i] * row[k] * r[i] / total
            for m in range(6):
                normal[k, m] += weight[i] * row[k] * row[m] / total
    return centre, size, normal, right
