"""Untrusted files: confined to the source folder, read up to a size limit, parsed as plain numbers."""

from __future__ import annotations

import glob
import re
import stat
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

from bask_data.errors import BadData, UsageError

MAX_TEXT_BYTES = 64 * 2**20
"""Largest text file that is read, bytes: poses of half a million frames. Keeps wrong files from filling memory."""

MAX_IMAGE_BYTES = 512 * 2**20
"""Largest image file that is read, bytes: more than an image of `MAX_PIXELS` takes. Keeps wrong files from filling
memory."""


def source_folder(source: Path) -> Path:
    """`source`, after checking that it is a folder; `UsageError` otherwise."""
    if not source.is_dir():
        raise UsageError(source, "SOURCE", expected="a folder", got="a file" if source.exists() else "no such path")
    return source


def member(source: Path, relative: str, field: str) -> Path:
    """The regular file at `relative` inside `source`; `BadData` for `..`, absolute paths and links that lead out."""
    pure = PurePosixPath(relative)
    if pure.is_absolute() or ".." in pure.parts:
        raise BadData(source, field, expected="a path inside the source folder", got=repr(relative))
    path = source / pure
    if not path.exists():
        raise BadData(path, field, expected="a file", got="no such path", fix="check SOURCE and the file names in it.")
    if not path.resolve().is_relative_to(source.resolve()):
        raise BadData(
            path,
            field,
            expected="a file inside the source folder",
            got="a link out of it",
            fix="copy the file into it.",
        )
    if not stat.S_ISREG(path.stat().st_mode):
        raise BadData(path, field, expected="a regular file", got="something else")
    return path


def matching(source: Path, pattern: str, option: str) -> dict[str, Path]:
    """Files that match `pattern`, by the text that its one `*` matches, in natural order.

    Raises:
        UsageError: the pattern has not exactly one `*`, or leaves the folder.
        BadData: no file matches.
    """
    if pattern.count("*") != 1:
        raise UsageError(
            f"--{option}", expected="a pattern with one *", got=repr(pattern), fix="for example 'frame-*.color.png'."
        )
    if PurePosixPath(pattern).is_absolute() or ".." in PurePosixPath(pattern).parts:
        raise UsageError(f"--{option}", expected="a pattern inside SOURCE", got=repr(pattern))
    before, after = pattern.split("*")
    key = re.compile(f"{re.escape(before)}([^/]+){re.escape(after)}")
    files = {}
    for path in source.glob(f"{glob.escape(before)}*{glob.escape(after)}"):
        relative = path.relative_to(source).as_posix()
        if match := key.fullmatch(relative):
            files[match.group(1)] = member(source, relative, f"--{option}")
    if not files:
        raise BadData(
            source, f"--{option}", expected=f"files that match {pattern!r}", got="none", fix=f"pass --{option} PATTERN."
        )
    return {name: files[name] for name in sorted(files, key=natural)}


def natural(text: str) -> list[tuple[int, int, str]]:
    """Sort key that orders frame 9 before frame 10."""
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in re.split(r"([0-9]+)", text) if part]


def frame_number(name: str) -> int | None:
    """The last integer in a frame's name; None if there is none."""
    numbers = re.findall(r"[0-9]+", name)
    return int(numbers[-1]) if numbers else None


def paired(source: Path, groups: dict[str, dict[str, Path]]) -> list[str]:
    """Names of the frames, after checking that each has a file in every group; `BadData` otherwise."""
    names = {name for group in groups.values() for name in group}
    for kind, group in groups.items():
        missing = sorted(names - set(group), key=natural)
        if missing:
            raise BadData(
                source,
                f"frame {listed(missing)}",
                expected=f"a {kind} file for every frame",
                got=f"none for {len(missing)} of {len(names)}",
                fix=f"check --{kind}, or remove the frames without {kind}.",
            )
    return sorted(names, key=natural)


def listed(names: Sequence[str], limit: int = 5) -> str:
    """The first names, and the number of further ones."""
    rest = len(names) - limit
    return ", ".join(names[:limit]) + (f" and {rest} more" if rest > 0 else "")


def read_bytes(path: Path, limit: int = MAX_IMAGE_BYTES) -> bytes:
    """A file's bytes; `BadData` for an empty file, or one above the limit in bytes."""
    size = path.stat().st_size
    if size == 0:
        raise BadData(path, "size", expected="some bytes", got="an empty file", fix="copy it again from its source.")
    if size > limit:
        raise BadData(path, "size", expected=f"at most {limit} bytes", got=f"{size}")
    return path.read_bytes()


def read_lines(path: Path) -> list[str]:
    """Lines of a text file without comments and blank lines; `BadData` for a binary file."""
    data = read_bytes(path, MAX_TEXT_BYTES)
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = "\0"
    if "\0" in text:
        raise BadData(path, "content", expected="text", got="a binary file", fix="check the option that names it.")
    lines = (line.split("#", 1)[0].strip() for line in text.splitlines())
    return [line for line in lines if line]


def numbers(path: Path, line: str) -> list[float]:
    """Numbers in a line, separated by spaces or commas; `BadData` for anything else."""
    try:
        return [float(word) for word in line.replace(",", " ").split()]
    except ValueError:
        fix = "separate numbers by spaces or commas, and begin remarks with #."
        raise BadData(path, "content", expected="numbers", got=repr(line[:80]), fix=fix) from None
