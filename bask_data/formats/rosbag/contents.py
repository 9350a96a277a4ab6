"""What one pass over a bag collects: where images are and when they were taken, calibrations, transforms, joints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from bask_data.errors import BadData
from bask_data.formats.options.rosbag import RosbagOptions
from bask_data.formats.rosbag.bag import Bag
from bask_data.formats.rosbag.files import MessagePlace
from bask_data.formats.rosbag.frames import FrameTree
from bask_data.formats.rosbag.topics import CameraTopics

STAMP_END = 12
"""Bytes of a message with a header before its frame's name: what differs in calibrations that are sent again."""

N_CALIBRATIONS = 1_000_000
"""Calibrations of a topic that are read, hours of them. Keeps a wrong bag from filling memory."""


@dataclass
class ImageStream:
    """Images of a topic, in order of their stamps.

    Args:
        stamps: nanoseconds.
        order: places in the bag.
        n_moved: messages that came after one with a later stamp.
    """

    stamps: list[int] = field(default_factory=list)
    places: list[MessagePlace] = field(default_factory=list)
    n_moved: int = 0

    def sort(self) -> None:
        """Order the images by their stamps, those with the same one by their arrival."""
        self.n_moved = sum(b < a for a, b in zip(self.stamps, self.stamps[1:], strict=False))
        order = sorted(range(len(self.stamps)), key=lambda i: (self.stamps[i], self.places[i].arrival))
        self.stamps = [self.stamps[i] for i in order]
        self.places = [self.places[i] for i in order]


@dataclass
class Calibrations:
    """CameraInfo messages of a topic; equal ones are decoded once.

    Args:
        stamps: nanoseconds.
        which: index into `messages` of each.
        frames: `frame_id` of each distinct one.
    """

    stamps: list[int] = field(default_factory=list)
    which: list[int] = field(default_factory=list)
    messages: list[Any] = field(default_factory=list)
    frames: list[str] = field(default_factory=list)
    _known: dict[bytes, int] = field(default_factory=dict)

    def add(self, bag: Bag, topic: str, raw: bytes) -> None:
        """One more message."""
        stamp, frame = bag.head(topic, raw)
        key = raw[STAMP_END:]
        if key not in self._known:
            self._known[key] = len(self.messages)
            self.messages.append(bag.decoded(topic, raw))
            self.frames.append(frame)
        if len(self.stamps) >= N_CALIBRATIONS:
            raise BadData(bag.paths[0], topic, expected=f"at most {N_CALIBRATIONS} messages", got="more")
        self.stamps.append(stamp)
        self.which.append(self._known[key])


@dataclass
class Joints:
    """Positions of joints, as far as they are asked for.

    Args:
        stamps: nanoseconds, by name.
    """

    stamps: dict[str, list[int]] = field(default_factory=dict)
    positions: dict[str, list[float]] = field(default_factory=dict)
    seen: set[str] = field(default_factory=set)

    def add(self, message: Any, names: Sequence[str]) -> None:
        """Positions in a JointState."""
        self.seen.update(message.name)
        stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
        for name, position in zip(message.name, message.position, strict=False):
            if name in names:
                self.stamps.setdefault(name, []).append(stamp)
                self.positions.setdefault(name, []).append(float(position))


@dataclass
class Contents:
    """A bag's messages, images only by their places.

    Args:
        poses: messages of `--pose-topic`.
    """

    images: dict[str, ImageStream]
    calibrations: dict[str, Calibrations]
    tree: FrameTree
    poses: list[Any] = field(default_factory=list)
    joints: Joints = field(default_factory=Joints)


def read_contents(bag: Bag, cameras: Sequence[CameraTopics], options: RosbagOptions) -> Contents:
    """One pass over a bag.

    Raises:
        BadData: stamps of images are missing, or what messages hold cannot be read.
    """
    images = {topic.name: ImageStream() for camera in cameras for topic in (camera.color, camera.depth)}
    infos = bag.of_type("CameraInfo")
    transforms = bag.of_type("TFMessage", "tfMessage")
    joint_names = [name.strip() for name in options.gripper_joints.split(",") if name.strip()]
    joint_topics = bag.of_type("JointState") if joint_names else []
    poses = [options.pose_topic] if options.pose_topic else []
    tree = FrameTree(str(bag.paths[0]), {}, options.max_pose_gap)
    contents = Contents(images, {topic: Calibrations() for topic in infos}, tree)
    whole = [*infos, *transforms, *joint_topics, *poses]
    for topic, place, raw in bag.scan({**dict.fromkeys(whole, True), **dict.fromkeys(images, False)}):
        if topic in images:
            stamp = place.arrival if options.stamps == "arrival" else bag.head(topic, raw)[0]
            images[topic].stamps.append(stamp)
            images[topic].places.append(place)
        elif topic in contents.calibrations:
            contents.calibrations[topic].add(bag, topic, raw)
        elif topic in transforms:
            contents.tree.add(bag.decoded(topic, raw), is_static=topic.endswith("tf_static"))
        elif topic in joint_topics:
            contents.joints.add(bag.decoded(topic, raw), joint_names)
        else:
            contents.poses.append(bag.decoded(topic, raw))
    contents.tree = contents.tree.without(options.ignore_tf)
    for topic, found in images.items():
        _check_stamps(bag, topic, found)
        found.sort()
    return contents


def _check_stamps(bag: Bag, topic: str, images: ImageStream) -> None:
    if not images.stamps:
        raise BadData(bag.paths[0], topic, expected="images", got="none")
    stamps = np.array(images.stamps, np.int64)
    n_empty = int((stamps == 0).sum())
    if n_empty > 1 or stamps.min() < 0 or (n_empty and stamps.max() > 10**15):
        raise BadData(
            bag.paths[0],
            f"{topic}: header.stamp",
            expected="the times at which the images were taken",
            got=f"0 in {n_empty} of {len(stamps)}" if n_empty else "negative ones",
            fix="pass --stamps arrival for the times at which they were recorded.",
        )
