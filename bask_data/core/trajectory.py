"""Poses between measured poses."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray
from scipy.spatial.transform import Rotation, Slerp


def interpolated(
    time: Float[ndarray, " n"],
    pose_time: Float[ndarray, " m"],
    world_from_x: Float[ndarray, "m 4 4"],
    max_gap: float,
) -> tuple[Float[ndarray, "n 4 4"], Bool[ndarray, " n"]]:
    """The poses of a moving frame x at the given times, and whether each is known; NaN where it is not.

    Between two poses the rotation turns about one axis at a constant rate, and the origin of x moves on a straight line
    at a constant speed. A screw, the other usual choice, bends this line by the rotation: at an angle w over a distance
    d it bows by d tan(w / 4) / 2, although nobody measured that the two belong together. The line is off by at most
    a h^2 / 8 at an acceleration a and poses h apart: 0.4 mm at 3 m/s^2 and 30 poses per second.

    Args:
        time: seconds on the clock of `pose_time`, in any order.
        pose_time: seconds; increases.
        world_from_x: rigid transforms.
        max_gap: seconds between two poses, beyond which nothing between them is known. A pose at exactly the time that
            is asked for is always known, and is returned as it is.

    Raises:
        ValueError: `pose_time` does not increase, or `max_gap` is negative.
    """
    if not (np.diff(pose_time) > 0).all():
        raise ValueError("pose_time: expected times that increase")
    if not max_gap >= 0:
        raise ValueError(f"max_gap: expected at least 0 s, got {max_gap}")
    poses = np.full((len(time), 4, 4), np.nan)
    # NaN is sorted to the end, and so is neither between two poses nor equal to one.
    after = np.searchsorted(pose_time, time)
    exact = np.isin(time, pose_time)
    poses[exact] = world_from_x[after[exact]]
    between = np.flatnonzero(~exact & (after > 0) & (after < len(pose_time)))
    gap = pose_time[after[between]] - pose_time[after[between] - 1]
    # Seconds since 1970 are rounded to 0.24 microseconds: poses at 10 Hz are not all within 0.1 s of each other.
    between = between[gap <= max_gap + 2 * np.spacing(np.abs(pose_time[after[between]]))]
    if len(between):
        i, at = after[between], time[between]
        share = (at - pose_time[i - 1]) / (pose_time[i] - pose_time[i - 1])
        begin, end = world_from_x[i - 1, :3, 3], world_from_x[i, :3, 3]
        poses[between] = np.eye(4)
        poses[between, :3, :3] = Slerp(pose_time, Rotation.from_matrix(world_from_x[:, :3, :3]))(at).as_matrix()
        poses[between, :3, 3] = begin + share[:, None] * (end - begin)
    is_known = exact.copy()
    is_known[between] = True
    return poses, is_known
