"""Correction of each pose of its own: a pose graph of motions measured between views, for poses that drift."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from bask_data.core.geometry import invert_rigid, nearest_rigid
from bask_data.core.pair_alignment import aligned
from bask_data.core.surface_views import SurfaceView

SAME_PLACE = 0.02
"""Distance, metres, from which on a loop closure that contradicts the others loses weight (Open3D's
`max_correspondence_distance` of the line process). Sensitivity not measured."""

PRUNED = 0.25
"""Weight below which a loop closure is dropped: Open3D's default."""


def undrifted(
    views: Sequence[SurfaceView],
    world_from_cameras: Float[ndarray, "t 4 4"],
    pairs: Sequence[tuple[int, int]],
) -> Float[ndarray, "t 4 4"]:
    """Poses from the motions between views, the first one as given.

    Successive views are joined whether depth says anything or not: by their given motion where it does not.

    Args:
        pairs: indices of views that overlap.

    Source: Choi, Zhou, Koltun 2015 (line process), as Open3D implements it.
    """
    import open3d.pipelines.registration as o3d  # Slow to import.

    n = len(views)
    successive = [(i, i + 1) for i in range(n - 1)]
    nodes = [o3d.PoseGraphNode(pose) for pose in world_from_cameras]
    edges = []
    for i, j in [*successive, *(pair for pair in pairs if pair[1] != pair[0] + 1)]:
        motion = aligned(views[i], views[j], invert_rigid(world_from_cameras[j]) @ world_from_cameras[i])
        if motion.is_measured or j == i + 1:
            edges.append(o3d.PoseGraphEdge(i, j, motion.b_from_a, motion.information, uncertain=j != i + 1))
    graph = o3d.PoseGraph()
    graph.nodes.extend(nodes)
    graph.edges.extend(edges)
    option = o3d.GlobalOptimizationOption(
        max_correspondence_distance=SAME_PLACE,
        edge_prune_threshold=PRUNED,
        preference_loop_closure=1.0,
        reference_node=0,
    )
    o3d.global_optimization(
        graph, o3d.GlobalOptimizationLevenbergMarquardt(), o3d.GlobalOptimizationConvergenceCriteria(), option
    )
    poses = np.stack([nearest_rigid(np.asarray(node.pose)) for node in graph.nodes])
    return world_from_cameras[0] @ invert_rigid(poses[0]) @ poses


def interpolated(
    corrected: Float[ndarray, "k 4 4"], given: Float[ndarray, "t 4 4"], index: Sequence[int]
) -> Float[ndarray, "t 4 4"]:
    """All poses, corrected as their nearest chosen frames before and after, in proportion.

    Args:
        corrected: of the chosen frames.
        index: the chosen frames, ascending, the first and the last of all among them.
    """
    from scipy.spatial.transform import Rotation, Slerp

    world_from_given = corrected @ invert_rigid(given[list(index)])
    every = np.arange(len(given))
    if len(index) == 1:
        return world_from_given[0] @ given
    # Positions of the cameras, not of the origin far away, are what moves smoothly.
    shifts = corrected[:, :3, 3] - given[list(index), :3, 3]
    result = given.copy()
    turns = Slerp(list(index), Rotation.from_matrix(world_from_given[:, :3, :3]))(every).as_matrix()
    result[:, :3, :3] = turns @ given[:, :3, :3]
    for axis in range(3):
        result[:, axis, 3] += np.interp(every, index, shifts[:, axis])
    return result
