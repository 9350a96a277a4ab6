"""MCAP files of ROS 2: https://mcap.dev/spec."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from bask_data.errors import imported
from bask_data.formats.files import MAX_IMAGE_BYTES
from bask_data.formats.rosbag.files import MESSAGE_HEAD_BYTES, Chunks, Data, Read, Topic, counted


class McapPart:
    """An MCAP file of ROS 2."""

    def __init__(self, path: Path) -> None:
        self._chunks = Chunks(path)
        reader = self._bounded(
            imported("rosbags.rosbag2.storage_mcap", "rosbags", user="ingest rosbag", extra="formats")
        )
        reader.open()
        self._span = (reader.data_start, reader.data_end)
        self._topic = {connection.id: connection.topic for connection in reader.connections}
        self.topics = tuple(Topic(c.topic, c.msgtype, c.msgcount) for c in reader.connections)
        reader.close()

    def _bounded(self, storage: Any) -> Any:
        """The reader of `rosbags`, which decompresses all chunks of a file without an index: only after they were
        found to be small enough."""
        part = self

        class BoundedReader(storage.McapReader):
            """See above."""

            def meta_scan(self) -> None:
                for _ in part._walk(part._chunks.read, self.data_start, self.data_end, -1, 0, {}, {}):
                    pass
                super().meta_scan()

        return BoundedReader(self._chunks.path)

    def scan(self, whole: dict[str, bool]) -> Iterator[tuple[str, tuple[int, int, int], bytes]]:
        """See `Part`."""
        wanted = {key: topic for key, topic in self._topic.items() if topic in whole}
        yield from self._walk(self._chunks.read, *self._span, -1, 0, wanted, whole)

    def message(self, chunk: int, offset: int) -> Data:
        """See `Part`."""
        read = self._chunks.read if chunk < 0 else self._chunk(chunk)[0]
        (size,) = struct.unpack("<Q", read(offset + 1, 8))
        if not 22 <= size <= MAX_IMAGE_BYTES:
            raise ValueError(f"a message of {size} bytes")
        data = read(offset + 9 + 22, size - 22)
        if len(data) < size - 22:
            raise ValueError("a message that is cut off")
        return data

    def _chunk(self, position: int) -> tuple[Read, int, int, bool]:
        """Access to the chunk whose record begins at `position`: where its content begins and ends, and whether it is
        compressed."""
        (size,) = struct.unpack("<Q", self._chunks.read(position + 1, 8))
        at, n_name = counted(self._chunks.read, position + 9 + 28, "name of a compression", 16)
        name = self._chunks.read(at, n_name).decode()
        (n_data,) = struct.unpack("<Q", self._chunks.read(at + n_name, 8))
        begin = at + n_name + 8
        if n_data > MAX_IMAGE_BYTES or begin + n_data > position + 9 + size:
            raise ValueError(f"a chunk of {n_data} bytes in a record of {size}")
        if not name:
            return self._chunks.read, begin, begin + n_data, False
        read = self._chunks.unpacked(position, begin, n_data, name)
        return read, 0, len(read(0, MAX_IMAGE_BYTES)), True

    def _walk(
        self,
        read: Read,
        at: int,
        end: int,
        chunk: int,
        depth: int,
        wanted: dict[int, str],
        whole: dict[str, bool],
    ) -> Iterator[tuple[str, tuple[int, int, int], bytes]]:
        """Messages between two offsets, also those in chunks between them."""
        while at < end:
            head = read(at, 31)
            kind, size = struct.unpack_from("<BQ", head)
            if kind == 5:
                channel, _, arrival = struct.unpack_from("<HIQ", head, 9)
                if topic := wanted.get(channel):
                    n_data = size - 22 if whole[topic] else min(size - 22, MESSAGE_HEAD_BYTES)
                    if not 0 <= n_data <= MAX_IMAGE_BYTES:
                        raise ValueError(f"a message of {n_data} bytes")
                    yield topic, (arrival, chunk, at), bytes(read(at + 31, n_data))
            elif kind == 6 and depth == 0:
                inner, begin, finish, is_packed = self._chunk(at)
                yield from self._walk(inner, begin, finish, at if is_packed else -1, 1, wanted, whole)
            at += 9 + size
