"""Poses of a bag's topic instead of tf."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from bask_data.errors import BadData
from bask_data.formats.files import listed
from bask_data.formats.options.rosbag import RosbagOptions
from bask_data.formats.rosbag.bag import Bag, frame_name
from bask_data.formats.rosbag.contents import Contents
from bask_data.formats.rosbag.edges import Edge
from bask_data.formats.rosbag.frames import FrameTree

POSE_TYPES = ("PoseStamped", "PoseWithCovarianceStamped", "Odometry", "TransformStamped", "Path")
"""Types of the messages of `--pose-topic`."""


def with_pose_topic(
    bag: Bag, contents: Contents, camera_frame: str, options: RosbagOptions
) -> tuple[FrameTree, str, str]:
    """The tree with the poses of `--pose-topic`, the frame whose pose is asked for, and the frame they are in."""
    topic = options.pose_topic
    if topic not in bag.of_type(*POSE_TYPES):
        there = listed(bag.of_type(*POSE_TYPES)) or "none"
        got = bag.topics[topic].type if topic in bag.topics else "no such topic"
        expected = f"a topic of {', '.join(POSE_TYPES)}; there are: {there}"
        raise BadData(bag.paths[0], f"--pose-topic {topic}", expected=expected, got=got, fix="pass one of them.")
    where = f"{bag.paths[0]}: {topic}"
    edge, parents, children = Edge(is_static=False), set(), set()
    last = contents.poses[-1:] if bag.topics[topic].type.endswith("/Path") else contents.poses
    for header, child, translation, rotation in (part for message in last for part in _pose_parts(message)):
        stamp = header.stamp.sec * 10**9 + header.stamp.nanosec
        if not stamp:
            raise BadData(where, "header.stamp", expected="the time of the pose", got="0", fix="pass another topic.")
        edge.add(stamp, translation, rotation)
        parents.add(frame_name(header.frame_id))
        children.add(frame_name(child))
    if len(parents) != 1 or len(children) != 1:
        got = f"{listed(sorted(parents))}, and {listed(sorted(children))}"
        raise BadData(where, "frame_id", expected="poses of one frame in one other", got=got or "no poses")
    parent, child = parents.pop(), frame_name(options.pose_frame) or children.pop() or camera_frame
    if options.gripper_from_camera:
        camera_frame = child
    if child != camera_frame and child not in contents.tree.chain(camera_frame):
        raise BadData(
            where,
            "child_frame_id",
            expected=f"tf between {child} and the camera's frame {camera_frame}",
            got="none",
            fix=f"pass --pose-frame {camera_frame} if these are its poses, or --gripper-from-camera FILE with its "
            f"pose in {child}.",
        )
    # The poses' own world stands above the frame, whatever tf has there: it may lag behind, or drift.
    world = parent if parent != child else "world"
    return contents.tree.replaced(world, child, edge), camera_frame, world


def _pose_parts(message: Any) -> Iterator[tuple[Any, str, Any, Any]]:
    """(header, child frame or empty, translation, rotation) of each pose in a message."""
    if hasattr(message, "poses"):
        for pose in message.poses:
            yield from _pose_parts(pose)
        return
    child = getattr(message, "child_frame_id", "")
    if hasattr(message, "transform"):
        yield message.header, child, message.transform.translation, message.transform.rotation
        return
    pose = message.pose.pose if hasattr(message.pose, "pose") else message.pose
    yield message.header, child, pose.position, pose.orientation
