"""The artifacts on disk: read at every query, or once for a command that makes nothing."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from bask_data.artifact import MANIFEST, Manifest, file_digest, read_manifest
from bask_data.errors import BadData


@dataclass(frozen=True, slots=True)
class Made:
    """How an artifact was made: a manifest without its list of files, as thousands are kept in memory."""

    key: str
    digest: str
    schema_version: int
    stage_version: int
    params: dict[str, Any]
    inputs: dict[str, str]


class Live:
    """Artifacts at the time of each query. For code that makes artifacts, as other processes may do so too."""

    def exists(self, path: Path) -> bool:
        """Whether anything exists at an artifact's path."""
        return path.exists()

    def has_manifest(self, path: Path) -> bool:
        """Whether there is an artifact; its manifest may be damaged."""
        return (path / MANIFEST).exists()

    def made(self, path: Path) -> Made:
        """How the artifact at `path` was made.

        Raises:
            BadData: its manifest is missing or damaged.
        """
        return _made(read_manifest(path))

    def file_digest(self, file: Path) -> str:
        """SHA-256 of a file that a parameter names."""
        return file_digest(file)


class Snapshot(Live):
    """Artifacts at the time of the first query: each folder is listed once and each manifest read once.

    For commands that make nothing (`status`, a dry run). A snapshot does not notice artifacts made later, so it must
    not outlive a command, and code that makes artifacts must not use it.
    """

    def __init__(self) -> None:
        self._names: dict[Path, frozenset[str]] = {}
        self._made: dict[Path, Made | Literal["missing", "broken"]] = {}
        self._digests: dict[Path, str] = {}

    def exists(self, path: Path) -> bool:
        """Whether anything existed at an artifact's path."""
        folder = path.parent
        if folder not in self._names:
            try:
                with os.scandir(folder) as entries:
                    self._names[folder] = frozenset(entry.name for entry in entries)
            except (FileNotFoundError, NotADirectoryError):
                self._names[folder] = frozenset()
        return path.name in self._names[folder]

    def has_manifest(self, path: Path) -> bool:
        """Whether there was an artifact."""
        return self._read(path) != "missing"

    def made(self, path: Path) -> Made:
        """How the artifact at `path` was made; `BadData` as from `Live`."""
        made = self._read(path)
        # A missing or damaged manifest is read again, to raise the error.
        return made if isinstance(made, Made) else super().made(path)

    def file_digest(self, file: Path) -> str:
        """SHA-256 of a file that a parameter names."""
        if file not in self._digests:
            self._digests[file] = super().file_digest(file)
        return self._digests[file]

    def _read(self, path: Path) -> Made | Literal["missing", "broken"]:
        if path not in self._made:
            self._made[path] = self._first_read(path)
        return self._made[path]

    def _first_read(self, path: Path) -> Made | Literal["missing", "broken"]:
        if not self.exists(path):
            return "missing"
        try:
            return super().made(path)
        except BadData:
            return "broken" if super().has_manifest(path) else "missing"


LIVE = Live()


def _made(manifest: Manifest) -> Made:
    return Made(
        manifest.key,
        manifest.digest,
        manifest.schema_version,
        manifest.stage_version,
        manifest.params,
        manifest.inputs,
    )
