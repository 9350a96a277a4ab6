"""Which frames of a recording are looked at: few enough to decode, close enough to compare."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from bask_data.core.geometry import view_change

N_SUSPECTS = 8
"""Frames looked at because their pose is off the path of its neighbours. Sensitivity not measured."""


def off_path(world_from_cameras: Float[ndarray, "t 4 4"]) -> Float[ndarray, " t"]:
    """How far each pose is from both neighbours, relative to their distance from each other: 0.5 on a smooth path.

    Distances count turns, too, at half a metre. The first and the last are 0.
    """
    n = len(world_from_cameras)
    relative = np.zeros(n)
    if n < 3:
        return relative

    def between(a: ndarray, b: ndarray) -> ndarray:
        distance, angle = view_change(a, b)
        return distance + 0.5 * angle

    step, skip = between(world_from_cameras[:-1], world_from_cameras[1:]), None
    skip = between(world_from_cameras[:-2], world_from_cameras[2:])
    floor = 0.2 * float(np.median(step)) + 1e-4
    relative[1:-1] = np.minimum(step[:-1], step[1:]) / (skip + floor)
    return relative


def looked_at(world_from_cameras: Float[ndarray, "t 4 4"], most: int) -> list[int]:
    """Numbers of the frames to look at, in order: all, or pairs of neighbours spread over the recording, and frames
    with their neighbours whose poses are far off the path."""
    n = len(world_from_cameras)
    if n <= most:
        return list(range(n))
    relative = off_path(world_from_cameras)
    suspects = [int(k) for k in np.argsort(-relative, kind="stable")[:N_SUSPECTS] if relative[k] > 1.5]
    chosen = {k + d for k in suspects for d in (-1, 0, 1)}
    # Starts and ends of pairs, the first and the last frame among them.
    starts = np.linspace(0, n - 2, max(2, (most - len(chosen)) // 2)).round().astype(int)
    return sorted(chosen | {int(k) for k in starts} | {int(k) + 1 for k in starts})
