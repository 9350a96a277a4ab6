"""Poses of a frame in its parent over time."""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy.spatial.transform import Rotation

from bask_data.core.trajectory import interpolated
from bask_data.errors import BadData
from bask_data.formats.poses import QUATERNION_TOLERANCE

USUAL_GAPS = 1.5
"""Interval between two transforms, in usual (median) ones, up to which they are interpolated: one message may be late.
Chosen, sensitivity not measured."""

LEAST_GAP = 0.1
"""Interval between two transforms, seconds, up to which they always are: 1 m/s^2 leaves an error of 1.3 mm. Chosen,
sensitivity not measured."""


@dataclass
class Edge:
    """Poses of a frame in its parent, in the order of the messages.

    Args:
        stamps: nanoseconds.
        values: x y z, qx qy qz qw of each, metres.
    """

    is_static: bool
    stamps: array[int] = field(default_factory=lambda: array("q"))
    values: array[float] = field(default_factory=lambda: array("d"))

    def add(self, stamp: int, translation: Any, rotation: Any) -> None:
        """One more pose."""
        self.stamps.append(stamp)
        self.values.extend(
            (translation.x, translation.y, translation.z, rotation.x, rotation.y, rotation.z, rotation.w)
        )


@dataclass(frozen=True)
class Poses:
    """Poses at some times.

    Args:
        matrices: NaN where unknown.
    """

    matrices: Float[ndarray, "n 4 4"]
    is_known: Bool[ndarray, " n"]


def poses_at(place: str, edge: Edge, stamps: Sequence[int], max_gap: float | None) -> Poses:
    """Poses interpolated at times in nanoseconds. What was sent twice counts once, as in tf2."""
    sent, first = np.unique(np.frombuffer(edge.stamps, np.int64), return_index=True)
    matrices = pose_matrices(place, np.frombuffer(edge.values).reshape(-1, 7)[first])
    # Nanoseconds since 1970 have more digits than a float: the difference is taken first.
    at, pose_time = since(stamps, int(sent[0])), since(sent, int(sent[0]))
    if max_gap is None:
        usual = float(np.median(np.diff(pose_time))) if len(pose_time) > 1 else 0.0
        max_gap = max(LEAST_GAP, USUAL_GAPS * usual)
    return Poses(*interpolated(at, pose_time, matrices, max_gap))


def since(stamps: Sequence[int] | Int[ndarray, " n"], start: int) -> Float[ndarray, " n"]:
    """Seconds from `start` of stamps, all in nanoseconds."""
    return (np.asarray(stamps, np.int64) - start) / 1e9


def pose_matrices(place: str, values: Float[ndarray, "n 7"]) -> Float[ndarray, "n 4 4"]:
    """Transforms of rows x y z qx qy qz qw; `BadData` for what is no rotation."""
    length = np.linalg.norm(values[:, 3:], axis=1)
    wrong = np.flatnonzero(~(np.isfinite(values).all(axis=1) & (np.abs(length - 1) <= QUATERNION_TOLERANCE)))
    if len(wrong):
        raise BadData(place, "rotation", expected="a quaternion of length 1", got=values[wrong[0]].tolist())
    matrices = np.tile(np.eye(4), (len(values), 1, 1))
    matrices[:, :3, :3] = Rotation.from_quat(values[:, 3:]).as_matrix()
    matrices[:, :3, 3] = values[:, :3]
    return matrices
