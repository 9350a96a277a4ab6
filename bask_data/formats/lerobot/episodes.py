"""The list of a LeRobot dataset's episodes: tables from v3.0 on, JSON lines before."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from bask_data.errors import BadData
from bask_data.formats.files import MAX_TEXT_BYTES, read_bytes
from bask_data.formats.json_values import parse_json
from bask_data.formats.lerobot.info import Info
from bask_data.formats.parquet_rows import ParquetRows


@dataclass(frozen=True)
class EpisodeEntry:
    """An episode in the list of episodes.

    Args:
        length: frames.
        fields: further values by name: where its videos begin; calibrations, in some datasets.
        files: the files that list it.
    """

    index: int
    length: int
    tasks: tuple[str, ...]
    fields: Mapping[str, Any] = field(repr=False)
    files: tuple[Path, ...] = ()


def list_episodes(info: Info) -> tuple[str, ...]:
    """Numbers of all episodes."""
    if info.is_v2:
        return tuple(str(_whole(info, row, "episode_index")) for row in _json_lines(info))
    return tuple(str(number) for table in _tables(info) for number in table.numbers("episode_index").tolist())


def find_episode(info: Info, name: str) -> EpisodeEntry:
    """The episode with a number."""
    number = int(name)
    if info.is_v2:
        path = info.folder.path / "meta/episodes.jsonl"
        row = next(row for row in _json_lines(info) if row.get("episode_index") == number)
        return EpisodeEntry(number, _whole(info, row, "length"), _tasks(row), row, (path,))
    for table in _tables(info):
        rows = (table.numbers("episode_index") == number).nonzero()[0]
        if len(rows):
            row = _row(table, int(rows[0]))
            return EpisodeEntry(number, _whole(info, row, "length"), _tasks(row), row, (table.path,))
    raise BadData(info.folder.path, "meta/episodes", expected=f"episode {number}", got="none")


def _tables(info: Info) -> list[ParquetRows]:
    """The tables of `meta/episodes`, in their order."""
    folder = info.folder
    found = sorted(path for path in folder.path.glob("meta/episodes/*/*.parquet") if not path.name.startswith("."))
    if not found:
        raise BadData(
            folder.path / "meta/episodes", "", expected="tables of episodes", got="none", fix="copy meta/ completely."
        )
    return [ParquetRows(folder.member(path.relative_to(folder.path).as_posix(), "meta/episodes")) for path in found]


def _row(table: ParquetRows, i: int) -> dict[str, Any]:
    """A row of a table of episodes, without the statistics, which are most of it."""
    names = [name for name in table.schema.names if not name.startswith("stats/") and table.has(name)]
    return {name: table.values(name, range(i, i + 1))[0] for name in names}


def _json_lines(info: Info) -> list[dict[str, Any]]:
    path = info.folder.member("meta/episodes.jsonl", "meta/episodes.jsonl")
    lines = read_bytes(path, MAX_TEXT_BYTES).splitlines()
    return [parse_json(path, line) for line in lines if line.strip()]


def _tasks(row: Mapping[str, Any]) -> tuple[str, ...]:
    tasks = row.get("tasks")
    return tuple(map(str, tasks)) if isinstance(tasks, list) else ()


def _whole(info: Info, row: Mapping[str, Any], name: str) -> int:
    value = row.get(name)
    if not isinstance(value, int) or value < 0:
        raise BadData(info.folder.path / "meta", name, expected="a whole number", got=repr(value)[:80])
    return value
