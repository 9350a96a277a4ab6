"""Names of files in a folder of unknown content, as far as is needed to tell what it is: bounded, and never outside."""

from __future__ import annotations

import os
from functools import cached_property
from itertools import islice
from pathlib import Path

MAX_NAMES = 5000
"""Names read of one folder: enough to see patterns; data sets have folders of millions of files."""

MAX_FOLDERS = 300
"""Folders looked into. Sensitivity not measured."""

MAX_LEVELS = 5
"""Levels of folders looked into: a task of RLBench in a split is as deep."""

HEAD_BYTES = 65536
"""Bytes read of a file to see what it is: the headers of all formats, and the first frames of a JSON file."""


class Listing:
    """Files and folders at a path, read on demand. Hidden ones are ignored, folders behind links not entered.

    Args:
        n_levels: levels of folders below that `all_folders` has.
    """

    def __init__(self, root: Path, n_levels: int = MAX_LEVELS) -> None:
        self.root = root
        self._n_levels = n_levels
        self._known: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {}

    def files(self, folder: str = "") -> tuple[str, ...]:
        """Names of the files in a folder, sorted; empty if there is no such folder."""
        return self._read(folder)[0]

    def folders(self, folder: str = "") -> tuple[str, ...]:
        """Names of the folders in a folder, sorted."""
        return self._read(folder)[1]

    def has(self, relative: str) -> bool:
        """Whether there is a file or folder at a path. Links count, whatever is behind them."""
        return os.path.lexists(self.root / relative)

    def has_folder(self, relative: str) -> bool:
        """Whether there is a folder at a path, not behind a link that leads out."""
        path = self.root / relative
        try:
            return path.is_dir() and path.resolve().is_relative_to(self.root.resolve())
        except OSError:  # In a folder that may not be entered, as lost+found.
            return False

    def head(self, relative: str, n_bytes: int = HEAD_BYTES) -> bytes:
        """The first bytes of a file; empty for one that cannot be read, is no regular file, or lies outside."""
        path = self.root / relative
        try:
            if not path.resolve().is_relative_to(self.root.resolve()) or not path.is_file():
                return b""
            with path.open("rb") as stream:
                return stream.read(n_bytes)
        except OSError:
            return b""

    def links_out(self) -> tuple[str, ...]:
        """Names of links to folders elsewhere, which are not entered, sorted."""
        try:
            with os.scandir(self.root) as entries:
                links = [each.name for each in islice(entries, MAX_NAMES) if each.is_symlink() and each.is_dir()]
        except OSError:
            return ()
        return tuple(sorted(name for name in links if not self.has_folder(name)))

    @cached_property
    def all_folders(self) -> tuple[str, ...]:
        """Paths of all folders, the root's as an empty text first, upper levels before lower ones."""
        found, level = [""], [""]
        for _ in range(self._n_levels):
            level = [f"{above}/{name}" if above else name for above in level for name in self.folders(above)]
            level = level[: max(MAX_FOLDERS - len(found), 0)]
            found += level
        return tuple(found)

    @property
    def upper_folders(self) -> tuple[str, ...]:
        """The root, as an empty text, and the folders in it, as far as `all_folders` has them."""
        return tuple(folder for folder in self.all_folders if "/" not in folder)

    def _read(self, folder: str) -> tuple[tuple[str, ...], tuple[str, ...]]:
        if folder not in self._known:
            files: list[str] = []
            folders: list[str] = []
            if self.has_folder(folder or "."):
                try:
                    with os.scandir(self.root / folder) as entries:
                        for entry in islice(entries, MAX_NAMES):
                            if entry.name.startswith("."):
                                continue
                            if entry.is_dir(follow_symlinks=False):
                                folders.append(entry.name)
                            elif not entry.is_dir() or self.has_folder(f"{folder}/{entry.name}".lstrip("/")):
                                (folders if entry.is_dir() else files).append(entry.name)
                except OSError:
                    pass
            self._known[folder] = (tuple(sorted(files)), tuple(sorted(folders)))
        return self._known[folder]
