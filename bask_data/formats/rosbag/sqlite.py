"""Databases of ROS 2's sqlite3 storage, .db3."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import quote

from bask_data.errors import imported
from bask_data.formats.files import MAX_IMAGE_BYTES, read_head
from bask_data.formats.rosbag.files import MESSAGE_HEAD_BYTES, ZSTD_MAGIC, Data, Topic, decompressed


class SqlitePart:
    """A database of ROS 2's sqlite3 storage."""

    def __init__(self, path: Path) -> None:
        reader = imported("rosbags.rosbag2", "rosbags", user="ingest rosbag", extra="formats").Reader(path)
        reader.open()
        self._path = path
        self._topic = {connection.id: connection.topic for connection in reader.connections}
        self.topics = tuple(Topic(c.topic, c.msgtype, c.msgcount) for c in reader.connections)
        reader.close()
        _refuse_cut_off(path)
        self._database = sqlite3.connect(
            f"file:{quote(str(path.resolve()))}?mode=ro&immutable=1", uri=True, check_same_thread=False
        )
        self._database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_IMAGE_BYTES)
        self._database.execute("PRAGMA trusted_schema = OFF")

    def scan(self, whole: dict[str, bool]) -> Iterator[tuple[str, tuple[int, int, int], bytes]]:
        """See `Part`."""
        wanted = [key for key, topic in self._topic.items() if topic in whole]
        heads = [key for key in wanted if not whole[self._topic[key]]]
        rows = self._database.execute(
            "SELECT id, topic_id, timestamp, "
            f"CASE WHEN topic_id IN ({_marks(heads)}) THEN substr(data, 1, {MESSAGE_HEAD_BYTES}) ELSE data END "
            f"FROM messages WHERE topic_id IN ({_marks(wanted)}) ORDER BY id",
            [*heads, *wanted],
        )
        for row, key, arrival, data in rows:
            if data[:4] == ZSTD_MAGIC:
                data = decompressed(self._path, self._whole(row), "zstd")
            yield self._topic[key], (arrival, -1, row), data

    def message(self, chunk: int, offset: int) -> Data:
        """See `Part`."""
        data = self._whole(offset)
        return decompressed(self._path, data, "zstd") if data[:4] == ZSTD_MAGIC else data

    def _whole(self, row: int) -> bytes:
        (data,) = self._database.execute("SELECT data FROM messages WHERE id = ?", (row,)).fetchone()
        return data


def _marks(values: list[int]) -> str:
    return ",".join("?" * len(values))


def _refuse_cut_off(path: Path) -> None:
    """SQLite reads pages that are missing at the end as zeros; the header says how many there should be."""
    head = read_head(path, 32)
    page, n_pages = int.from_bytes(head[16:18], "big"), int.from_bytes(head[28:32], "big")
    if path.stat().st_size < n_pages * (65536 if page == 1 else page):
        raise ValueError("a database that is cut off")
