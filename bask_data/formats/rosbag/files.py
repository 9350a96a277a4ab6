"""Bags of ROS 1 and ROS 2 as files: their topics, one pass over chosen ones, and single messages by their place.

`rosbags` opens the bags and knows their topics. Messages are fetched here, by the place that the first pass noted: its
own reading goes in order of time from a start, and decompresses without a limit.

Formats: http://wiki.ros.org/Bags/Format/2.0, https://mcap.dev/spec, and the tables of rosbag2's sqlite3 storage.
"""

from __future__ import annotations

import os
import struct
from collections import OrderedDict
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, Protocol

from bask_data.errors import BadData, imported
from bask_data.formats.files import MAX_IMAGE_BYTES
from bask_data.formats.rosbag.spool import Spool

MESSAGE_HEAD_BYTES = 512
"""Bytes of a message that hold its header: a stamp, and a frame's name of up to this length less 20."""

N_CHUNKS_KEPT = 4
"""Decompressed chunks that are kept: colour and depth of a frame are in neighbouring ones. Sensitivity not measured."""

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
"""First bytes of what zstd compressed. Messages begin with 0, 0 or 1."""


class MessagePlace(NamedTuple):
    """Where a message is.

    Args:
        arrival: nanoseconds, when it was recorded.
        part: index of the file.
        chunk: position of its chunk in the file; -1 if it is in none.
        offset: bytes from there, or the row of a database.
    """

    arrival: int
    part: int
    chunk: int
    offset: int


class Message(NamedTuple):
    """A message of a topic; its first `MESSAGE_HEAD_BYTES` or all of its bytes."""

    topic: str
    place: MessagePlace
    raw: bytes


@dataclass(frozen=True)
class Topic:
    """A topic: the type of its messages, as `sensor_msgs/msg/Image`, and their number."""

    name: str
    type: str
    n_messages: int


Data = bytes | memoryview
"""Bytes; those of a message in a decompressed chunk are not copied."""


class Part(Protocol):
    """A file of a bag."""

    topics: tuple[Topic, ...]

    def scan(self, whole: dict[str, bool]) -> Iterator[tuple[str, tuple[int, int, int], bytes]]:
        """Messages of topics: topic, (arrival, chunk, offset), and bytes, all or only the head."""

    def message(self, chunk: int, offset: int) -> Data:
        """All bytes of the message at a place."""


Read = Callable[[int, int], Data]
"""Bytes from an offset, of a file or of a decompressed chunk: (offset, count). Fewer at its end."""


class Chunks:
    """A file, and the last of its chunks that were decompressed."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file = path.open("rb")
        self._kept: OrderedDict[int, bytes] = OrderedDict()
        self._spool = Spool()

    def read(self, offset: int, count: int) -> bytes:
        """Bytes of the file."""
        return os.pread(self._file.fileno(), count, offset)

    def unpacked(self, key: int, begin: int, size: int, compression: str) -> Read:
        """Access to the chunk at `begin`, decompressed."""
        if not compression:
            return lambda offset, count: self.read(begin + offset, min(count, max(size - offset, 0)))
        data = self._kept.get(key)
        if data is None:
            data = self._spool.get(key)
            if data is None:
                data = decompressed(self.path, self.read(begin, size), compression)
                if compression == "bz2":
                    self._spool.put(key, data)
            self._kept[key] = data
            while len(self._kept) > N_CHUNKS_KEPT or sum(map(len, self._kept.values())) > MAX_IMAGE_BYTES:
                self._kept.popitem(last=False)
        view = memoryview(data)
        return lambda offset, count: view[offset : offset + count]


def decompressed(path: Path, data: bytes, compression: str) -> bytes:
    """What was compressed by bz2, lz4 or zstd; `BadData` if it is damaged, or larger than any image."""
    module, name = {
        "bz2": ("bz2", "BZ2Decompressor"),
        "lz4": ("lz4.frame", "LZ4FrameDecompressor"),
        "zstd": ("backports.zstd", "ZstdDecompressor"),
    }.get(compression, ("", ""))
    if not module:
        raise BadData(path, "compression", expected="bz2, lz4 or zstd", got=compression)
    decoder = getattr(imported(module, module, user="ingest rosbag", extra="formats"), name)()
    try:
        found = decoder.decompress(data, max_length=MAX_IMAGE_BYTES + 1)
    except Exception as error:  # Each library has its own, lz4 a plain RuntimeError.
        raise damaged(path, "chunk", error) from error
    if len(found) > MAX_IMAGE_BYTES:
        raise BadData(path, "chunk", expected=f"at most {MAX_IMAGE_BYTES} bytes", got="more, decompressed")
    if not decoder.eof:
        raise damaged(path, "chunk", "a truncated one")
    return found


def damaged(path: Path, what: str, error: object) -> BadData:
    """The error for content that is not as the format has it."""
    got = f"{type(error).__name__}: {error}" if isinstance(error, Exception) else str(error)
    remedy = {
        ".bag": f"`rosbag reindex {path.name}` mends",
        ".mcap": f"`mcap recover {path.name} -o mended.mcap` mends",
        ".db3": "`ros2 bag reindex` mends",
    }.get(path.suffix.lower(), "`ros2 bag reindex` mends")
    fix = f"copy the bag again; {remedy} recordings that were cut off."
    return BadData(path, what, expected="a readable one", got=got[:200], fix=fix)


def counted(read: Read, offset: int, what: str, limit: int = MAX_IMAGE_BYTES) -> tuple[int, int]:
    """(begin, size) of what its size in four bytes precedes."""
    size = struct.unpack("<I", read(offset, 4))[0]
    if size > limit:
        raise ValueError(f"{what} of {size} bytes")
    return offset + 4, size
