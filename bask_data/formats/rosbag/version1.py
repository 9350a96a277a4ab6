"""Files of ROS 1: http://wiki.ros.org/Bags/Format/2.0."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path

from bask_data.errors import imported
from bask_data.formats.rosbag.files import MESSAGE_HEAD_BYTES, Chunks, Data, Topic, counted


class BagPart:
    """A bag of ROS 1."""

    def __init__(self, path: Path) -> None:
        reader = imported("rosbags.rosbag1", "rosbags", user="ingest rosbag", extra="formats").Reader(path)
        reader.open()
        self._chunks = Chunks(path)
        self._begin = {position: (chunk.datapos, chunk.datasize) for position, chunk in reader.chunks.items()}
        self._index = dict(reader.indexes)
        self._topic = {connection.id: connection.topic for connection in reader.connections}
        self.topics = tuple(Topic(c.topic, c.msgtype, c.msgcount) for c in reader.connections)
        reader.close()

    def scan(self, whole: dict[str, bool]) -> Iterator[tuple[str, tuple[int, int, int], bytes]]:
        """See `Part`."""
        entries = [
            (entry.chunk_pos, entry.offset, entry.time, topic)
            for connection, topic in self._topic.items()
            if topic in whole
            for entry in self._index[connection]
        ]
        for chunk, offset, arrival, topic in sorted(entries):
            raw = self._read(chunk, offset, None if whole[topic] else MESSAGE_HEAD_BYTES)
            yield topic, (arrival, chunk, offset), bytes(raw)

    def message(self, chunk: int, offset: int) -> Data:
        """See `Part`."""
        return self._read(chunk, offset, None)

    def _read(self, chunk: int, offset: int, most: int | None) -> Data:
        begin, size = self._begin[chunk]
        # The first bytes tell: a chunk that is not compressed begins with the small length of a record's header.
        magic = self._chunks.read(begin, 4)
        compression = "bz2" if magic[:3] == b"BZh" else "lz4" if magic == b"\x04\x22\x4d\x18" else ""
        read = self._chunks.unpacked(chunk, begin, size, compression)
        while True:
            at, n_header = counted(read, offset, "record header", 2**20)
            kind = _bag_fields(bytes(read(at, n_header))).get(b"op")
            at, n_data = counted(read, at + n_header, "message")
            if kind == b"\x02":
                data = read(at, n_data if most is None else min(n_data, most))
                if most is None and len(data) < n_data:
                    raise ValueError("a message that is cut off")
                return data
            if kind != b"\x07":  # Descriptions of topics may stand before a message.
                raise ValueError(f"a record {kind!r} for a message")
            offset = at + n_data


def _bag_fields(header: bytes) -> dict[bytes, bytes]:
    """Fields of a record's header in a bag of ROS 1."""
    fields, at = {}, 0
    while at < len(header):
        (size,) = struct.unpack_from("<I", header, at)
        name, _, value = header[at + 4 : at + 4 + size].partition(b"=")
        fields[name] = value
        at += 4 + size
    return fields
