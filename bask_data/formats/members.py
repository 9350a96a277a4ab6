"""Files of a recording by name, whether in a folder or in a zip file."""

from __future__ import annotations

import struct
import zipfile
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import Protocol, runtime_checkable

from bask_data.errors import BadData, UsageError
from bask_data.formats.files import MAX_IMAGE_BYTES, Folder, natural, read_bytes, source_file

PACKED = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
"""Ways of packing that are read: of all others, `zipfile` unpacks the whole before it looks at a limit."""

UNREADABLE = (
    zipfile.BadZipFile,
    zlib.error,
    struct.error,
    NotImplementedError,
    RuntimeError,
    OSError,
    EOFError,
    ValueError,
)
"""What `zipfile` raises for damaged, encrypted and unknown content."""


@runtime_checkable
class Members(Protocol):
    """The files of a recording. Names are relative paths with `/`."""

    def has(self, name: str) -> bool:
        """Whether there is a file of this name."""

    def named(self, folder: str, suffixes: Sequence[str]) -> dict[str, str]:
        """Names of the files in a folder with one of the suffixes, by their stems, in natural order; hidden ones not.

        Empty if there is no such folder.

        Raises:
            BadData: two files have the same stem.
        """

    def read(self, name: str, limit: int = MAX_IMAGE_BYTES) -> bytes:
        """The content of a file.

        Raises:
            BadData: there is no such file, it is empty, damaged, leads out, or is larger than `limit` bytes.
        """

    def place(self, name: str) -> str:
        """Where a file is, for messages."""

    def files(self, names: Sequence[str]) -> tuple[Path, ...]:
        """The files on disc that hold these members."""


@dataclass(frozen=True)
class FolderMembers:
    """The files in a folder."""

    folder: Folder

    def has(self, name: str) -> bool:
        """See `Members`."""
        return self.folder.has(name)

    def named(self, folder: str, suffixes: Sequence[str]) -> dict[str, str]:
        """See `Members`."""
        path = self.folder.path / folder
        inside = [f"{folder}/{file.name}" for file in path.iterdir()] if path.is_dir() else []
        return by_stem(self.place(folder), inside, suffixes)

    def read(self, name: str, limit: int = MAX_IMAGE_BYTES) -> bytes:
        """See `Members`."""
        return read_bytes(self.folder.member(name, "file"), limit)

    def place(self, name: str) -> str:
        """See `Members`."""
        return str(self.folder.path / name)

    def files(self, names: Sequence[str]) -> tuple[Path, ...]:
        """See `Members`."""
        return tuple(self.folder.member(name, "file") for name in names)


@dataclass(frozen=True)
class ZipMembers:
    """The files in a zip file, read into memory one at a time; nothing is unpacked to disc.

    Args:
        inside: folder in the zip file that the names are relative to, with `/` at its end, or empty.
    """

    path: Path
    inside: str = ""

    def has(self, name: str) -> bool:
        """See `Members`."""
        return self.inside + name in self._names

    def named(self, folder: str, suffixes: Sequence[str]) -> dict[str, str]:
        """See `Members`."""
        start = f"{self.inside}{folder}/"
        names = [name for name in self._names if name.startswith(start) and "/" not in name[len(start) :]]
        return by_stem(self.place(folder), [name[len(self.inside) :] for name in names], suffixes)

    def read(self, name: str, limit: int = MAX_IMAGE_BYTES) -> bytes:
        """See `Members`."""
        try:
            packing = self._zip.getinfo(self.inside + name).compress_type
            if packing not in PACKED:
                got, fix = f"method {packing}", "unpack it, and pass the folder."
                raise BadData(self.place(name), "packing", expected="deflate, or none", got=got, fix=fix)
            with self._zip.open(self.inside + name) as file:
                # The size that the zip file states need not be that of the content.
                data = file.read(limit + 1)
        except KeyError:
            raise BadData(self.path, name, expected="a file in the zip file", got="none of this name") from None
        except UNREADABLE as error:
            raise self._damaged(name, error) from error
        if not data:
            raise BadData(self.place(name), "size", expected="some bytes", got="an empty file")
        if len(data) > limit:
            raise BadData(self.place(name), "size", expected=f"at most {limit} bytes", got="more")
        return data

    def place(self, name: str) -> str:
        """See `Members`."""
        return f"{self.path}/{self.inside}{name}"

    def files(self, names: Sequence[str]) -> tuple[Path, ...]:
        """See `Members`."""
        return (self.path,)

    def at(self, name: str) -> ZipMembers:
        """These files seen from the folder, nearest to the top, that has a file or a folder `name` in it.

        As they are if there is none; exports often lie in a folder of their own.
        """
        starts = [known[: f"/{known}".find(f"/{name}")] for known in self._names if f"/{name}" in f"/{known}"]
        return ZipMembers(self.path, min(starts, key=len)) if starts else self

    @cached_property
    def _zip(self) -> zipfile.ZipFile:
        try:
            return zipfile.ZipFile(self.path)
        except UNREADABLE as error:
            raise self._damaged("content", error) from error

    @cached_property
    def _names(self) -> frozenset[str]:
        return frozenset(
            name for name in self._zip.namelist() if not name.endswith("/") and not name.startswith("__MACOSX/")
        )

    def _damaged(self, field: str, error: Exception) -> BadData:
        got = str(error)[:200] or type(error).__name__
        return BadData(self.path, field, expected="a zip file", got=got, fix="copy it again from its source.")


def members_of(source: Path, suffixes: tuple[str, ...], follow_links: bool) -> FolderMembers | ZipMembers:
    """The files of `source`, a folder or a zip file with one of the suffixes; `UsageError` for anything else."""
    if source.is_dir():
        return FolderMembers(Folder(source, follow_links))
    if not source.exists():
        raise UsageError(source, "SOURCE", expected=f"a folder or a file {suffixes[0]}", got="no such path")
    return ZipMembers(source_file(source, suffixes, follow_links))


def by_stem(place: str, names: Sequence[str], suffixes: Sequence[str]) -> dict[str, str]:
    """Those of the names that have one of the suffixes, by their stems, in natural order, without hidden files."""
    found: dict[str, str] = {}
    for name in sorted(names):
        path = PurePosixPath(name)
        if path.suffix.lower() not in suffixes or path.name.startswith("."):
            continue
        if path.stem in found:
            got = f"{PurePosixPath(found[path.stem]).name} and {path.name}"
            fix = "remove the one that is not meant."
            raise BadData(place, path.stem, expected="one file for each frame", got=got, fix=fix)
        found[path.stem] = name
    return {stem: found[stem] for stem in sorted(found, key=natural)}
