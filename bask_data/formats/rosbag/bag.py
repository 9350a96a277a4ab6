"""A bag of one file or several: its topics, and its messages, decoded by `rosbags`."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from threading import Lock
from typing import Any

from bask_data.errors import BadData, BaskError, imported
from bask_data.formats.rosbag.files import ZSTD_MAGIC, Data, Message, MessagePlace, Part, Topic, damaged, decompressed
from bask_data.formats.rosbag.mcap import McapPart
from bask_data.formats.rosbag.sqlite import SqlitePart
from bask_data.formats.rosbag.version1 import BagPart

PARTS: dict[str, Callable[[Path], Part]] = {".bag": BagPart, ".mcap": McapPart, ".db3": SqlitePart}
"""Kinds of files by their suffix."""

TRANSFORMS = "tf2_msgs/msg/TFMessage"
"""Type of the messages of tf."""

SAME_TYPES = {"tf/msg/tfMessage": TRANSFORMS}
"""Types that are laid out as others, which the libraries know."""


class Bag:
    """A recording of ROS, in one file or several.

    Args:
        paths: its files, in order.
    """

    def __init__(self, paths: tuple[Path, ...]) -> None:
        self.paths = paths
        self.is_ros1 = paths[0].suffix.lower() == ".bag"
        self._lock = Lock()  # Parts keep what they decompressed last.
        self._parts: list[Part] = []
        for path in paths:
            with _reading(path, "bag"):
                self._parts.append(PARTS[path.suffix.lower()](path))
        self.topics: dict[str, Topic] = {}
        for part in self._parts:
            for topic in part.topics:
                before = self.topics.get(topic.name)
                if before is not None and before.type != topic.type:
                    got = f"{before.type} and {topic.type}"
                    raise BadData(paths[0], topic.name, expected="messages of one type", got=got)
                n = topic.n_messages + (before.n_messages if before else 0)
                self.topics[topic.name] = Topic(topic.name, topic.type, n)

    def of_type(self, *types: str) -> list[str]:
        """Topics whose messages are of one of the types, as `Image` or `TFMessage`, and which have any."""
        return sorted(
            topic.name for topic in self.topics.values() if topic.n_messages and topic.type.split("/")[-1] in types
        )

    def scan(self, whole: dict[str, bool]) -> Iterator[Message]:
        """One pass over the messages of topics, in the order of the files.

        Args:
            whole: the topics; whether all of a message is needed, or only its header. May be changed on the way.
        """
        for i, part in enumerate(self._parts):
            with _reading(self.paths[i], "messages"):
                for topic, (arrival, chunk, offset), raw in part.scan(whole):
                    if raw[:4] == ZSTD_MAGIC:
                        raw = bytes(self.raw(topic, MessagePlace(arrival, i, chunk, offset)))
                    yield Message(topic, MessagePlace(arrival, i, chunk, offset), raw)

    def raw(self, topic: str, place: MessagePlace) -> Data:
        """All bytes of the message at a place."""
        path = self.paths[place.part]
        with self._lock, _reading(path, topic):
            raw = self._parts[place.part].message(place.chunk, place.offset)
            return decompressed(path, bytes(raw), "zstd") if raw[:4] == ZSTD_MAGIC else raw

    def decoded(self, topic: str, raw: Data) -> Any:
        """A message, as `rosbags` knows its type. Definitions inside the bag are not used: those of ROS are known."""
        name = self.topics[topic].type
        with _reading(self.paths[0], f"{topic} ({name})"):
            types = _types(self.is_ros1)
            decode = types.deserialize_ros1 if self.is_ros1 else types.deserialize_cdr
            return decode(memoryview(raw), SAME_TYPES.get(name, name))

    def head(self, topic: str, raw: bytes) -> tuple[int, str]:
        """Stamp in nanoseconds and frame of a message that begins with a header."""
        with _reading(self.paths[0], f"{topic}: header"):
            if self.is_ros1:
                _, seconds, nanoseconds, size = struct.unpack_from("<IIII", raw)
            else:
                order = "<" if raw[1] & 1 else ">"
                seconds, nanoseconds, size = struct.unpack_from(f"{order}iII", raw, 4)
                size -= 1
            if not 0 <= size <= len(raw) - 16:
                raise ValueError(f"frame_id of {size} bytes")
            return seconds * 10**9 + nanoseconds, frame_name(raw[16 : 16 + size].decode())


@cache
def _types(is_ros1: bool) -> Any:
    """The message types of ROS. Those that are read here have had the same layout in all releases of ROS 2."""
    typesys = imported("rosbags.typesys", "rosbags", user="ingest rosbag", extra="formats")
    types = typesys.get_typestore(typesys.Stores.ROS1_NOETIC if is_ros1 else typesys.Stores.ROS2_HUMBLE)
    if TRANSFORMS not in types.types:
        types.register(typesys.get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TRANSFORMS))
    return types


def frame_name(text: str) -> str:
    """A frame as tf2 writes it: tf1 had a slash before some."""
    return text.lstrip("/")


@contextmanager
def _reading(path: Path, what: str) -> Iterator[None]:
    """Errors of damaged files become `BadData`: libraries raise whatever the damage leads to."""
    try:
        yield
    except (BaskError, GeneratorExit):
        raise
    except Exception as error:
        if "not indexed" in str(error):
            fix = f"rosbag reindex {path.name}"
            raise BadData(path, what, expected="a bag with an index", got="none", fix=fix) from error
        raise damaged(path, what, error) from error
