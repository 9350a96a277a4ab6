"""What lies in a dataset: read anew at every question, or once for a command that only looks."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from bask_data.artifact import MANIFEST, Manifest, file_digest, read_manifest
from bask_data.errors import BadData


@dataclass(frozen=True, slots=True)
class Made:
    """What a manifest says of how an artifact was made; thousands of them are kept, so the list of files is not."""

    key: str
    digest: str
    schema_version: int
    stage_version: int
    params: dict[str, Any]
    inputs: dict[str, str]


class Live:
    """Artifacts as they are at each question. What makes artifacts asks this: others may be making some, too."""

    def exists(self, path: Path) -> bool:
        """Whether there is anything at an artifact's place."""
        return path.exists()

    def has_manifest(self, path: Path) -> bool:
        """Whether there is an artifact; its manifest may be broken."""
        return (path / MANIFEST).exists()

    def made(self, path: Path) -> Made:
        """How the artifact at `path` was made.

        Raises:
            BadData: its manifest is missing or broken.
        """
        return _made(read_manifest(path))

    def file_digest(self, file: Path) -> str:
        """SHA-256 of a file that a parameter names."""
        return file_digest(file)


class Snapshot(Live):
    """Artifacts as they were when first asked for: folders are listed once, manifests are read once.

    For commands that make nothing (`status`, a dry run). Nothing tells a snapshot that an artifact was made meanwhile,
    so it lives no longer than one command, and nothing that makes artifacts may ask it.
    """

    def __init__(self) -> None:
        self._names: dict[Path, frozenset[str]] = {}
        self._made: dict[Path, Made | Literal["missing", "broken"]] = {}
        self._digests: dict[Path, str] = {}

    def exists(self, path: Path) -> bool:
        """Whether there was anything at an artifact's place."""
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
        """How the artifact at `path` was made; `BadData` as `Live` raises it."""
        found = self._read(path)
        # What is missing or broken is read once more, which raises the error that says so.
        return found if isinstance(found, Made) else super().made(path)

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
