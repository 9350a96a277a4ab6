"""The tree of frames that /tf and /tf_static hold, and transforms between two of its frames at given times.

tf calls `header.frame_id` the parent: its messages hold parent_from_child. Unlike tf2, which takes the newest parent of
a frame and extrapolates nowhere, two parents are refused; between two stamps it interpolates as tf2 does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bask_data.core.geometry import invert_rigid
from bask_data.errors import BadData, UsageError
from bask_data.formats.files import listed
from bask_data.formats.rosbag.bag import frame_name
from bask_data.formats.rosbag.edges import Edge, Poses, pose_matrices, poses_at


@dataclass(frozen=True)
class FrameTree:
    """All transforms of a bag.

    Args:
        where: the bag, for messages.
        edges: by child and parent.
        max_gap: seconds; see `RosbagOptions.max_pose_gap`.
    """

    where: str
    edges: dict[str, dict[str, Edge]]
    max_gap: float | None

    def add(self, message: Any, is_static: bool) -> None:
        """The transforms of a TFMessage."""
        for transform in message.transforms:
            parent, child = frame_name(transform.header.frame_id), frame_name(transform.child_frame_id)
            parents = self.edges.setdefault(child, {})
            edge = parents.get(parent)
            # As in tf2, the last of several static transforms holds, and a static one goes before others.
            if edge is None or (is_static and not edge.is_static):
                edge = parents[parent] = Edge(is_static)
            elif edge.is_static and not is_static:
                continue
            stamp = transform.header.stamp
            edge.add(stamp.sec * 10**9 + stamp.nanosec, transform.transform.translation, transform.transform.rotation)

    def replaced(self, parent: str, child: str, edge: Edge) -> FrameTree:
        """The tree in which a frame has this parent, and no other."""
        return FrameTree(self.where, {**self.edges, child: {parent: edge}}, self.max_gap)

    def without(self, text: str) -> FrameTree:
        """The tree without the edges PARENT:CHILD,PARENT:CHILD of `--ignore-tf`; `UsageError` for unknown ones."""
        edges = {child: dict(parents) for child, parents in self.edges.items()}
        for pair in filter(None, text.split(",")):
            parent, _, child = pair.strip().partition(":")
            if edges.get(child, {}).pop(parent, None) is None:
                known = [f"{parent}:{child}" for child, parents in self.edges.items() for parent in parents]
                raise UsageError("--ignore-tf", expected=f"PARENT:CHILD among {listed(known, 10)}", got=pair)
        return FrameTree(self.where, {child: parents for child, parents in edges.items() if parents}, self.max_gap)

    @property
    def frames(self) -> set[str]:
        """Names of all frames."""
        return set(self.edges) | {parent for parents in self.edges.values() for parent in parents}

    def chain(self, frame: str) -> list[str]:
        """The frame, its parent, and so on to the root; `BadData` for two parents of one, and for circles."""
        chain = [frame]
        while parents := self.edges.get(chain[-1]):
            if len(parents) > 1:
                child = chain[-1]
                raise BadData(
                    self.where,
                    f"tf: {child}",
                    expected="one parent",
                    got=" and ".join(sorted(parents)),
                    fix=f"ignore the wrong one: --ignore-tf {sorted(parents)[-1]}:{child}",
                )
            (parent,) = parents
            if parent in chain:
                raise BadData(
                    self.where,
                    "tf",
                    expected="a tree",
                    got=f"a circle: {' -> '.join([*chain, parent])}",
                    fix=f"ignore one of its transforms: --ignore-tf {parent}:{chain[-1]}",
                )
            chain.append(parent)
        return chain

    def moves(self, a: str, b: str) -> bool:
        """Whether any transform between two frames may change."""
        return any(not self._edge(child).is_static for child in [*self._below(a, b), *self._below(b, a)])

    def a_from_b(self, a: str, b: str, stamps: Sequence[int]) -> Poses:
        """Transforms from frame b to frame a at times in nanoseconds, in any order.

        Raises:
            BadData: the frames are not in one tree, or a rotation is no unit quaternion.
        """
        up, down = self._product(self._below(b, a), stamps), self._product(self._below(a, b), stamps)
        matrices = np.full((len(stamps), 4, 4), np.nan)
        known = up.is_known & down.is_known
        matrices[known] = invert_rigid(down.matrices[known]) @ up.matrices[known]
        return Poses(matrices, known)

    def _below(self, frame: str, other: str) -> list[str]:
        """The frame and its parents below the first one that is above the other, too."""
        chain, others = self.chain(frame), self.chain(other)
        shared = [name for name in chain if name in others]
        if not shared:
            raise BadData(
                self.where,
                "tf",
                expected=f"{frame} and {other} in one tree",
                got=f"{frame} below {chain[-1]}, and {other} below {others[-1]}",
                fix="pass --world or --camera-frame with another frame.",
            )
        return chain[: chain.index(shared[0])]

    def _edge(self, child: str) -> Edge:
        (edge,) = self.edges[child].values()
        return edge

    def _product(self, children: list[str], stamps: Sequence[int]) -> Poses:
        """top_from_children[0]: the transforms of each child to its parent, the first child's applied first."""
        matrices, known = np.tile(np.eye(4), (len(stamps), 1, 1)), np.ones(len(stamps), bool)
        for child in children:
            poses = self._at(child, stamps)
            matrices, known = poses.matrices @ matrices, known & poses.is_known
        return Poses(matrices, known)

    def _at(self, child: str, stamps: Sequence[int]) -> Poses:
        edge = self._edge(child)
        place = f"{self.where}: tf: {child}"
        if edge.is_static:
            matrix = pose_matrices(place, np.array(edge.values[-7:])[None])
            return Poses(np.repeat(matrix, len(stamps), axis=0), np.ones(len(stamps), bool))
        return poses_at(place, edge, stamps, self.max_gap)
