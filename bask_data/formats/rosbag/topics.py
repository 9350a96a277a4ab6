"""Which topics of a bag are the colour and depth images of a camera."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

from bask_data.errors import BadData
from bask_data.formats.rosbag.bag import Bag, frame_name
from bask_data.formats.rosbag.images import ImageKind, color_of, depth_of, image_kind

TRANSPORT = re.compile(r"/(compressed|compressedDepth|raw)$")
"""What image_transport appends to the topic of the images."""

ALIGNED = re.compile(r"aligned_depth_to_color|depth_registered|registered_depth|depth_to_(rgb|color)")
"""Names of depth that its driver has brought onto colour's pixels: RealSense, OpenNI and Kinect 2, Azure Kinect."""

RECTIFIED = re.compile(r"/image_rect|/rect/|_rect(/|$)")
"""Names of images whose lens distortion was taken out: P of CameraInfo is theirs."""


@dataclass(frozen=True)
class ImageTopic:
    """A topic of images, by its first message.

    Args:
        frame: its `frame_id`.
        size: (height, width), pixels; (0, 0) if the first one cannot be decoded.
    """

    name: str
    kind: ImageKind
    frame: str
    size: tuple[int, int]
    n_messages: int

    @property
    def base(self) -> str:
        """The topic without what image_transport appended."""
        return TRANSPORT.sub("", self.name)

    @property
    def parts(self) -> list[str]:
        """Parts of the name before its last one: the namespaces of the camera."""
        return self.base.split("/")[1:-1]

    @property
    def is_rectified(self) -> bool:
        """Whether lens distortion was taken out."""
        return bool(RECTIFIED.search(self.base))

    @property
    def info(self) -> str:
        """Where image_transport has the CameraInfo of these images."""
        return self.base.rpartition("/")[0] + "/camera_info"


@dataclass(frozen=True)
class CameraTopics:
    """Topics of a camera's images."""

    color: ImageTopic
    depth: ImageTopic

    @property
    def is_aligned(self) -> bool:
        """Whether depth lies on colour's pixels, as far as frames, names and sizes say."""
        is_named = bool(ALIGNED.search(self.depth.name)) and self.color.parts[:-1] == self.depth.parts[:-1]
        return (is_named or self.color.frame == self.depth.frame) and self.color.size == self.depth.size


def image_topics(bag: Bag, names: Sequence[str]) -> dict[str, ImageTopic]:
    """Topics of images by their first messages."""
    found = {}
    missing = dict.fromkeys(names, True)
    for message in bag.scan(missing):
        if not missing[message.topic]:
            continue
        missing[message.topic] = False  # From here on, the pass reads only heads of this topic.
        decoded = bag.decoded(message.topic, message.raw)
        kind = image_kind(message.topic, decoded)
        found[message.topic] = ImageTopic(
            message.topic,
            kind,
            frame_name(decoded.header.frame_id),
            _size(decoded, kind),
            bag.topics[message.topic].n_messages,
        )
        if not any(missing.values()):
            break
    return found


def _size(message: Any, kind: ImageKind) -> tuple[int, int]:
    if not kind.is_compressed:
        return message.height, message.width
    try:
        image = depth_of("", message) if kind.is_depth else color_of("", message)
    except BadData:
        return 0, 0
    return image.shape[0], image.shape[1]


def chosen_topics(bag: Bag, color: str, depth: str) -> CameraTopics:
    """Topics of a camera: those that options name, or the only ones that can be meant.

    Raises:
        BadData: a topic is not there or holds no images, none fits, or several do; with all topics.
    """
    there = bag.of_type("Image", "CompressedImage")
    for option, name in (("--color-topic", color), ("--depth-topic", depth)):
        if name and name not in there:
            raise _refused(bag, option, "a topic of images", name)
    if color and depth:
        topics = image_topics(bag, [color, depth])
        return CameraTopics(topics[color], topics[depth])
    topics = image_topics(bag, there)
    colors = [topics[color]] if color else [topic for topic in topics.values() if not topic.kind.is_depth]
    depths = [topics[depth]] if depth else [topic for topic in topics.values() if topic.kind.is_depth]
    if not colors or not depths:
        lacking = "--color-topic" if not colors else "--depth-topic"
        what = "colour" if not colors else "depth (16UC1 or 32FC1)"
        raise _refused(bag, lacking, f"images of {what}", "none")
    pairs = sorted((CameraTopics(*pair) for pair in product(colors, depths)), key=_fitness, reverse=True)
    best = pairs[0]
    for other in pairs[1:]:
        is_other_camera = other.color.frame != best.color.frame or other.color.parts[:1] != best.color.parts[:1]
        if is_other_camera and _fitness(other)[:3] == _fitness(best)[:3]:
            got = f"{best.color.name} with {best.depth.name}, and {other.color.name} with {other.depth.name}"
            raise _refused(bag, "--color-topic and --depth-topic", "images of one camera", got)
    return best


def _fitness(topics: CameraTopics) -> tuple[int, bool, int, bool, bool, bool, str]:
    """How well two topics may be the colour and depth of a camera: the larger, the better. The first three say which
    camera, the others which of its images: as recorded before rectified, and not compressed before compressed."""
    color, depth = topics.color, topics.depth
    shared = 0
    for a, b in zip(color.parts, depth.parts, strict=False):
        if a != b:
            break
        shared += 1
    named_color = any(word in color.base for word in ("rgb", "color", "colour"))
    return (
        color.kind.color_rank,
        topics.is_aligned,
        shared,
        not color.kind.is_compressed,
        not depth.kind.is_compressed,
        named_color,
        f"{'' if color.is_rectified else '~'}{color.name} {depth.name}",
    )


def _refused(bag: Bag, option: str, expected: str, got: str) -> BadData:
    """The error for topics that are not clear, with all topics of the bag."""
    lines = [
        f"  {topic.name}: {topic.type.replace('/msg/', '/')}, {topic.n_messages}"
        for topic in sorted(bag.topics.values(), key=lambda topic: topic.name)
    ]
    error = BadData(
        bag.paths[0],
        "topics",
        expected=expected,
        got=got,
        fix=f"pass {option} with one of the topics below, or --camera with several names and their topics.",
    )
    error.add_note("\n".join(["topics, their types and numbers of messages:", *lines[:100]]))
    return error
