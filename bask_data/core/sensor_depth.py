"""Faults of a depth sensor that many frames share: values at the end of a range, coarse steps, noise, a bowl."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from bask_data.core.depth import SIGMA_FROM_MAD
from bask_data.core.sensor_frames import BlockPoints, FrameMeasures

STUCK_SHARE = 0.005
"""Share of the measured pixels with exactly the largest or smallest value for it to be an end of the range. Single
values of real sensors have up to 0.001, the near end of a Kinect 0.004."""

MARK_RATIO = 1.5
"""A largest value so many times the next one is no distance but a mark, such as 65535."""

PLANE_TRIPLES = 80
"""Planes tried in a frame: a plane with half of the points is missed once in 40,000. Sensitivity not measured."""

N_POINTS_OF_PLANE = 2500
"""Points of a frame that a plane is fitted to. Sensitivity not measured."""

N_JUDGED_PLANES = 24
"""Frames, spread over the recording, whose planes are fitted."""

ON_PLANE = 0.02
"""Distance from a plane, relative to depth, that a bowl may have at the image's edge. Sensitivity not measured."""

LEAST_PLANE = 0.35
"""Share of a frame's points on one plane for it to be judged."""

LEAST_REACH = 0.75
"""Share of the image's width that the plane must reach across."""

LEAST_PLANES = 4
"""Frames with a plane below which a bowl is not judged."""


@dataclass(frozen=True)
class RangeEnd:
    """A value at which depth stands in many frames.

    Args:
        value: metres.
        share: of the measured pixels, median over the frames that have it.
        n_frames: frames that have it.
        is_mark: whether it is far from all other values: a mark for no measurement rather than a distance.
    """

    value: float
    share: float
    n_frames: int
    is_mark: bool


def range_ends(frames: Sequence[FrameMeasures]) -> list[RangeEnd]:
    """Values at which depth is stuck, at the near and the far end."""
    seen = [frame for frame in frames if frame.measured > 0]
    ends = []
    for is_far in (True, False):
        values = np.array([frame.farthest if is_far else frame.nearest for frame in seen])
        shares = np.array([frame.at_farthest if is_far else frame.at_nearest for frame in seen])
        if not len(values):
            continue
        if is_far:
            following = np.array([frame.next_farthest for frame in seen])
            marks = (following > 0) & (values > MARK_RATIO * following) & (shares > STUCK_SHARE / 50)
            for value in np.unique(values[marks]):
                same = marks & (values == value)
                # A single odd pixel is noise; a value that comes again in other frames is a mark.
                if same.sum() >= 2:
                    ends.append(RangeEnd(float(value), float(np.median(shares[same])), int(same.sum()), True))
        unique, counts = np.unique(values, return_counts=True)
        value = unique[counts.argmax()]
        same = (values == value) & (shares > STUCK_SHARE)
        if same.sum() >= max(2, 0.5 * len(seen)) and not any(end.value == value for end in ends):
            ends.append(RangeEnd(float(value), float(np.median(shares[same])), int(same.sum()), False))
    return ends


@dataclass(frozen=True)
class Bowl:
    """The curvature that planes have in all frames.

    Args:
        edge: error of depth at the left and right edge of the image against its middle, relative to depth; positive is
            too far.
        depth: median of the planes, metres.
        n_frames: frames with a plane.
        is_sure: whether frames agree on it.
    """

    edge: float
    depth: float
    n_frames: int
    is_sure: bool


def bowl(frames: Sequence[BlockPoints], width: int, rng: np.random.Generator) -> Bowl | None:
    """The curvature of large planes in the image; None where there are too few.

    Inverse depth of a plane is linear over the image; what is left with the square of the distance from the middle is
    the sensor's. It is taken in inverse depth, as errors of disparity are.

    Args:
        width: of the image, pixels.
    """
    bends, depths = [], []
    for blocks in frames[:: max(1, len(frames) // N_JUDGED_PLANES)]:
        found = _bend(blocks, rng)
        if found is not None:
            bends.append(found[0])
            depths.append(found[1])
    if len(bends) < LEAST_PLANES:
        return None
    bend, depth = np.array(bends), float(np.median(depths))
    half = width / 2 / frames[0].K[0, 0]
    middle = float(np.median(bend))
    error = SIGMA_FROM_MAD * float(np.median(np.abs(bend - middle))) / np.sqrt(len(bend)) * 1.25 + 1e-12
    same_sign = float((np.sign(bend) == np.sign(middle)).mean())
    edge = -middle * half**2
    return Bowl(edge, depth, len(bend), bool(abs(middle) > 4 * error and same_sign > 0.85))


def _bend(blocks: BlockPoints, rng: np.random.Generator) -> tuple[float, float] | None:
    """Coefficient of the squared distance from the middle, relative to inverse depth, and the plane's depth."""
    points = blocks.points.reshape(-1, 3)
    points = points[np.isfinite(points[:, 2])].astype(np.float64)
    if len(points) < 300:
        return None
    points = points[:: max(1, len(points) // N_POINTS_OF_PLANE)]
    x, y, inverse = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2], 1 / points[:, 2]
    flat = np.stack([x, y, np.ones(len(x))], axis=1)
    best = _largest_plane(flat, inverse, rng)
    if best.mean() < LEAST_PLANE:
        return None
    columns = blocks.points.shape[1] * blocks.step / blocks.K[0, 0]
    if np.ptp(np.quantile(x[best], [0.02, 0.98])) < LEAST_REACH * columns:
        return None
    curved = np.concatenate([flat, (x**2 + y**2)[:, None]], axis=1)
    weight = best.astype(float)
    scale = float(np.median(inverse[best]))
    solution = np.zeros(4)
    for _ in range(6):
        weighted = curved * weight[:, None]
        solution = np.linalg.lstsq(weighted.T @ curved, weighted.T @ inverse, rcond=None)[0]
        error = np.abs(inverse - curved @ solution) / inverse
        sigma = max(SIGMA_FROM_MAD * float(np.median(error[best])), 1e-6)
        weight = np.clip(1 - (error / (4 * sigma)) ** 2, 0, None) * (error < ON_PLANE)
    return float(solution[3]) / scale, 1 / scale


def _largest_plane(
    flat: Float[ndarray, "n 3"], inverse: Float[ndarray, " n"], rng: np.random.Generator
) -> Bool[ndarray, " n"]:
    """The points on the largest plane, in the image's coordinates and inverse depth."""
    triples = rng.integers(len(flat), size=(PLANE_TRIPLES, 3))
    matrices = flat[triples]
    good = np.abs(np.linalg.det(matrices)) > 1e-4
    if not good.any():
        return np.zeros(len(flat), bool)
    planes = np.linalg.solve(matrices[good], inverse[triples[good]][..., None])[..., 0]
    some = slice(None, None, 4)
    near = np.abs(flat[some] @ planes.T - inverse[some, None]) < ON_PLANE * inverse[some, None]
    best = planes[near.sum(axis=0).argmax()]
    return np.asarray(np.abs(flat @ best - inverse) < ON_PLANE * inverse)
