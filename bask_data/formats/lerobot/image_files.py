"""Image files of an episode: inside the table, or beside it, by a path or where LeRobot puts them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path, PurePosixPath

from bask_data.errors import BadData
from bask_data.formats.files import read_bytes
from bask_data.formats.lerobot.columns import EpisodeRows
from bask_data.formats.lerobot.episodes import EpisodeEntry
from bask_data.formats.lerobot.info import Feature
from bask_data.formats.parquet_values import RowValues

REMOTE = ("http://", "https://", "hf://", "s3://")
"""Beginnings of addresses that some tables hold instead of images."""

PLACES = (
    "images/{key}/episode-{episode:06d}/frame-{frame:06d}",
    "images/{key}/episode_{episode:06d}/frame_{frame:06d}",
    "images/chunk-{chunk:03d}/{key}/episode_{episode:06d}/frame_{frame:06d}",
)
"""Where LeRobot keeps images that are not in the tables, from v3.0 on and before."""

SUFFIXES = (".png", ".tiff", ".tif", ".jpg", ".jpeg")


class EpisodeFiles:
    """Image files of one feature in one episode.

    Args:
        files: those outside the table.
        faults: why frames have none, by their numbers.
    """

    def __init__(self, rows: EpisodeRows, entry: EpisodeEntry, feature: Feature) -> None:
        """Find the files; nothing is decoded."""
        self._rows, self._entry, self._key = rows, entry, feature.key
        self._values = RowValues(rows.table.path, feature.key) if rows.has(feature.key) else None
        self.n_frames = rows.n_frames
        self.faults: dict[int, BadData] = {}
        self._beside: dict[int, Path] = {}
        if self._values is None or self._values.files_of(rows.rows.start)[0] is None:
            self._find()

    @property
    def files(self) -> tuple[Path, ...]:
        """Files outside the table."""
        return tuple(self._beside.values())

    def read(self, i: int) -> tuple[str, bytes]:
        """A name for messages, and the content of the frame's image file; `BadData` if there is none."""
        if i in self.faults:
            raise self.faults[i]
        if i in self._beside:
            return str(self._beside[i]), read_bytes(self._beside[i])
        row = self._rows.rows[i]
        where = f"{self._rows.table.path}: {self._key} of row {row}"
        data = self._values.files_of(row)[0] if self._values else None
        if data is None:
            raise BadData(where, "image", expected="an image", got="none", fix="copy the table again.")
        return where, data

    def _find(self) -> None:
        """Find the files that lie outside the table."""
        for i in range(self.n_frames):
            data, path = self._values.files_of(self._rows.rows[i]) if self._values else (None, None)
            if data is not None:
                continue
            try:
                self._beside[i] = self._file(i, path)
            except BadData as error:
                self.faults[i] = error

    def _file(self, i: int, path: str | None) -> Path:
        folder = self._rows.info.folder
        if path and path.startswith(REMOTE):
            raise BadData(
                folder.path,
                self._key,
                expected="images in the dataset",
                got=f"an address: {path[:80]}",
                fix="download the dataset with its images.",
            )
        usual = list(self._usual(i))
        pure = PurePosixPath(path or "")
        if path and not pure.is_absolute() and ".." not in pure.parts:
            usual.insert(0, path)
        # Tables of datasets that were moved hold absolute paths, or names alone.
        found = next((place for place in usual if folder.has(place)), path or usual[0])
        return folder.member(found, self._key)

    def _usual(self, i: int) -> Iterator[str]:
        episode = self._entry.index
        chunk = self._rows.info.chunk_of(episode)
        for place in PLACES:
            for suffix in SUFFIXES:
                yield place.format(key=self._key, episode=episode, frame=i, chunk=chunk) + suffix
