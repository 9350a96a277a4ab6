"""One pose of a static object from annotations of it in many frames."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial.transform import Rotation

from bask_data.formats.recording import ObjectPose

STATIC_SPREAD = 0.02
"""Largest spread of an object's annotated origins, metres, with which it counts as static. Annotations by hand and by
tracking scatter by millimetres. Chosen; sensitivity not measured."""

SPREAD_SHARE = 0.95
"""Share of an object's frames that lie within its spread, so that a few bad annotations do not make it a moving one.
Chosen; sensitivity not measured."""

N_COMPARED = 200
"""Frames, spread over the recording, whose rotations are compared with each other."""


def static_pose(world_from_objects: Float[ndarray, "n 4 4"]) -> ObjectPose:
    """The pose that the annotations have in common.

    The origin is the median. The rotation is the one that is nearest to all others: a mean would lie between the
    rotations that a symmetric object may be annotated with.

    Args:
        world_from_objects: the annotations, metres, at least one.

    Returns:
        The pose; its error is the distance from the origin within which `SPREAD_SHARE` of the annotations lie.
    """
    origin = np.median(world_from_objects[:, :3, 3], axis=0)
    chosen = np.unique(np.linspace(0, len(world_from_objects) - 1, N_COMPARED).astype(int))
    rotations = Rotation.from_matrix(world_from_objects[chosen, :3, :3])
    angles = [(rotations * rotation.inv()).magnitude().sum() for rotation in rotations]
    pose = np.eye(4)
    pose[:3, :3] = rotations[int(np.argmin(angles))].as_matrix()
    pose[:3, 3] = origin
    distances = np.linalg.norm(world_from_objects[:, :3, 3] - origin, axis=1)
    return ObjectPose(pose, float(np.quantile(distances, SPREAD_SHARE)))


def static_poses(annotated: dict[int, list[Float[ndarray, "4 4"]]]) -> tuple[dict[int, ObjectPose], list[int]]:
    """Poses of the static objects by label, and the labels of those that move."""
    poses = {label: static_pose(np.stack(seen)) for label, seen in annotated.items() if seen}
    moving = [label for label, pose in poses.items() if pose.error > STATIC_SPREAD]
    return {label: pose for label, pose in poses.items() if label not in moving}, moving
