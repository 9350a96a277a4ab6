"""Untrusted files: confined to the source folder, read up to a size limit, parsed as plain numbers."""

from __future__ import annotations

import glob
import re
import shlex
import stat
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import TypeVar

from bask_data.errors import BadData, UsageError

Item = TypeVar("Item")
Result = TypeVar("Result")

MAX_TEXT_BYTES = 64 * 2**20
"""Largest text file that is read, bytes: poses of half a million frames. Keeps wrong files from filling memory."""

MAX_IMAGE_BYTES = 512 * 2**20
"""Largest image file that is read, bytes: more than an image of `MAX_PIXELS` takes. Keeps wrong files from filling
memory."""

MAX_SHOWN = 300
"""Characters of a path that are shown of one that leads nowhere: it may come from a stranger's file."""


@dataclass(frozen=True)
class Folder:
    """A source folder: every file of a recording is found through it, and lies inside it.

    Args:
        follow_links: whether links may lead out of the folder, to files whose content is read as if it lay inside.
    """

    path: Path
    follow_links: bool = False

    def member(self, relative: str, field: str) -> Path:
        """The regular file at `relative`; `BadData` for `..`, absolute paths and links that lead out."""
        pure = PurePosixPath(relative)
        if pure.is_absolute() or ".." in pure.parts:
            raise BadData(
                self.path,
                field,
                expected="a path inside the source folder",
                got=repr(relative),
                fix="copy the file into SOURCE, and name it relative to that.",
            )
        path = self.path / pure
        if not self.has(relative) or not path.exists():
            broken = self.has(relative)
            raise BadData(
                f"{path}"[:MAX_SHOWN],
                field,
                expected="a file",
                got="a link to nothing" if broken else "no such path",
                fix="fetch the content that the link stands for (`dvc pull`, `git annex get`)."
                if broken
                else "check SOURCE and the file names in it.",
            )
        if not self.follow_links and not path.resolve().is_relative_to(self.path.resolve()):
            raise BadData(
                path,
                field,
                expected="a file inside the source folder",
                got="a link out of it",
                fix="pass --follow-links if the links are your own (DVC, git-annex, another disc), or copy the files.",
            )
        if not stat.S_ISREG(path.stat().st_mode):
            raise BadData(path, field, expected="a regular file", got="a folder, pipe or device", fix="check SOURCE.")
        return path

    def has(self, relative: str) -> bool:
        """Whether there is something at `relative`; `member` says whether it may be read."""
        path = self.path / relative
        try:
            return path.exists() or path.is_symlink()
        except OSError:  # A name that no file can have: too long.
            return False

    def matching(self, pattern: str, option: str, *, is_fixed: bool = False) -> dict[str, Path]:
        """Files that match `pattern`, by the text that its one `*` matches, in natural order. Hidden files are ignored.

        Args:
            is_fixed: whether the format has this pattern, and no option of that name changes it.

        Raises:
            UsageError: the pattern has not exactly one `*`, or leaves the folder.
            BadData: no file matches.
        """
        if pattern.count("*") != 1:
            raise UsageError(
                f"--{option}",
                expected="a pattern with one *",
                got=repr(pattern),
                fix="for example 'frame-*.color.png'.",
            )
        if PurePosixPath(pattern).is_absolute() or ".." in PurePosixPath(pattern).parts:
            raise UsageError(f"--{option}", expected="a pattern inside SOURCE", got=repr(pattern))
        before, after = pattern.split("*")
        key = re.compile(f"{re.escape(before)}([^/]+){re.escape(after)}")
        files = {}
        for path in self.path.glob(f"{glob.escape(before)}*{glob.escape(after)}"):
            relative = path.relative_to(self.path).as_posix()
            match = key.fullmatch(relative)
            if match and not path.name.startswith("."):
                files[match.group(1)] = self.member(relative, f"--{option}")
        if not files:
            raise BadData(
                self.path,
                option if is_fixed else f"--{option}",
                expected=f"files that match {pattern!r}",
                got="none",
                fix="check SOURCE." if is_fixed else f"pass --{option} PATTERN.",
            )
        return {name: files[name] for name in sorted(files, key=natural)}

    def files_in(self, relative: str, endings: tuple[str, ...], what: str) -> dict[str, Path]:
        """Files whose names have one of the endings, by what is before it, in natural order. Hidden files are ignored.

        Args:
            relative: the folder they are in.
            endings: in lower case: `.png`, `-color.jpg`.

        Raises:
            BadData: there are none, or there are two of the same name.
        """
        files: dict[str, Path] = {}
        for path in sorted((self.path / relative).glob("*")):
            ending = next((ending for ending in endings if path.name.lower().endswith(ending)), None)
            if ending is None or path.name.startswith("."):
                continue
            name = path.name[: -len(ending)]
            if name in files:
                got = f"{files[name].name} and {path.name}"
                fix = "remove the one that is not meant."
                raise BadData(self.path / relative, what, expected="one file for each frame", got=got, fix=fix)
            files[name] = self.member(path.relative_to(self.path).as_posix(), what)
        if not files:
            expected = f"files {' or '.join(f'*{ending}' for ending in endings)}"
            raise BadData(self.path / relative, what, expected=expected, got="none", fix="check SOURCE.")
        return {name: files[name] for name in sorted(files, key=natural)}


def folder_of(source: Path, follow_links: bool = False) -> Folder:
    """`source`, or the folder that it lies in if it is a file: where files that options name are looked for."""
    return Folder(source if source.is_dir() else source.parent, follow_links)


def source_folder(source: Path, follow_links: bool = False) -> Folder:
    """`source` as a folder; `UsageError` if it is none."""
    if not source.is_dir():
        raise UsageError(source, "SOURCE", expected="a folder", got="a file" if source.exists() else "no such path")
    return Folder(source, follow_links)


def source_file(source: Path, suffixes: tuple[str, ...], follow_links: bool = False) -> Path:
    """`source` as one file with one of the suffixes; `UsageError` otherwise."""
    if not source.is_file() or source.suffix.lower() not in suffixes:
        got = "a folder" if source.is_dir() else (f"a file {source.suffix}" if source.exists() else "no such path")
        raise UsageError(source, "SOURCE", expected=f"a file {' or '.join(suffixes)}", got=got)
    return Folder(source.parent, follow_links).member(source.name, "SOURCE")


def natural(text: str) -> list[tuple[int, int, str]]:
    """Sort key that orders frame 9 before frame 10."""
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in re.split(r"([0-9]+)", text) if part]


def frame_number(name: str) -> int | None:
    """The last integer in a frame's name; None if there is none."""
    numbers = re.findall(r"[0-9]+", name)
    return int(numbers[-1]) if numbers else None


def paired(
    source: Path, groups: dict[str, dict[str, Path]], *, patterns: bool = True
) -> tuple[list[str], dict[str, BadData]]:
    """Names of all frames, in natural order, and for each that lacks a file in some group the error that says so.

    Args:
        patterns: whether the groups come from options of the same names, which may be wrong.
    """
    names = sorted({name for group in groups.values() for name in group}, key=natural)
    faults: dict[str, BadData] = {}
    for kind, group in groups.items():
        missing = [name for name in names if name not in group]
        for name in missing:
            faults.setdefault(
                name,
                BadData(
                    source,
                    f"frame {listed([name, *(other for other in missing if other != name)])}",
                    expected=f"a {kind} file for every frame",
                    got=f"none for {len(missing)} of {len(names)}",
                    fix=(f"check --{kind}, or " if patterns else "")
                    + f"pass --skip-bad to leave out the frames without {kind}.",
                ),
            )
    return names, faults


def listed(names: Sequence[str], limit: int = 5) -> str:
    """The first names, and the number of further ones."""
    rest = len(names) - limit
    return ", ".join(names[:limit]) + (f" and {rest} more" if rest > 0 else "")


def first_readable(read: Callable[[Item], Result], items: Iterable[Item]) -> Result:
    """What the first of the items gives that can be read, such as the size of images of which some are broken.

    Args:
        items: at least one.

    Raises:
        BadData: none can be read; the first one's.
    """
    first: BadData | None = None
    for item in items:
        try:
            return read(item)
        except BadData as error:
            first = first or error
    assert first is not None
    raise first


def read_bytes(path: Path, limit: int = MAX_IMAGE_BYTES) -> bytes:
    """A file's bytes; `BadData` for an empty file, or one above the limit in bytes."""
    size = path.stat().st_size
    if size == 0:
        raise BadData(path, "size", expected="some bytes", got="an empty file", fix="copy it again from its source.")
    if size > limit:
        raise BadData(path, "size", expected=f"at most {limit} bytes", got=f"{size}")
    return path.read_bytes()


def read_head(path: Path, n_bytes: int) -> bytes:
    """The first bytes of a file, as many as there are; `BadData` for an empty file."""
    with path.open("rb") as file:
        head = file.read(n_bytes)
    return head or read_bytes(path)


def read_lines(path: Path) -> list[str]:
    """Lines of a text file without comments and blank lines; `BadData` for a binary file."""
    return [line for _, line in numbered_lines(path)]


def numbered_lines(path: Path) -> list[tuple[int, str]]:
    """As `read_lines`, each line with its number in the file, from 1."""
    data = read_bytes(path, MAX_TEXT_BYTES)
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = "\0"
    if "\0" in text:
        raise BadData(path, "content", expected="text", got="a binary file", fix="check the option that names it.")
    lines = ((i, line.split("#", 1)[0].strip()) for i, line in enumerate(text.splitlines(), 1))
    return [(i, line) for i, line in lines if line]


def without_header(lines: list[tuple[int, str]]) -> list[tuple[int, str]]:
    """The lines without a first one that names the columns, as in CSV files: one of several words, none a number."""
    words = words_of(lines[0][1]) if len(lines) > 1 else []
    return lines[1:] if len(words) > 1 and not any(map(is_number, words)) else lines


def words_of(line: str) -> list[str]:
    """Words in a line, separated by spaces, commas or semicolons, in brackets or not."""
    return _BRACKETS.sub(" ", line).replace(",", " ").split()


def is_number(word: str) -> bool:
    """Whether a word is a number; NaN and infinity are."""
    try:
        float(word)
    except ValueError:
        return False
    return True


def numbers(path: Path, line: str) -> list[float]:
    """Numbers in a line, separated by spaces, commas or semicolons, in brackets or not; `BadData` for anything else."""
    words = _BRACKETS.sub(" ", line).split()
    _refuse_decimal_commas(path, line, words)
    try:
        return [float(word) for text in words for word in text.split(",") if word]
    except ValueError:
        fix = "separate numbers by spaces or commas, and begin remarks with #."
        raise BadData(path, "content", expected="numbers", got=repr(line[:80]), fix=fix) from None


_BRACKETS = re.compile(r"[\[\](){};]")
_DECIMAL_COMMA = re.compile(r"[-+]?\d+,\d+([eE][-+]?\d+)?")
_NO_COMMA = re.compile(r"[^,.]+")


def _refuse_decimal_commas(path: Path, line: str, words: list[str]) -> None:
    """Refuse `0,5 1,25`: separated by spaces already, so that commas in between can be nothing else."""
    with_comma = [word for word in words if "," in word]
    if len(words) < 2 or not with_comma:
        return
    if all(_DECIMAL_COMMA.fullmatch(word) or _NO_COMMA.fullmatch(word) for word in words):
        files = f"{shlex.quote(str(path.parent))}/*{path.suffix}" if path.is_file() else "FILE"
        raise BadData(
            path,
            "content",
            expected="numbers with decimal points",
            got=f"decimal commas: {line[:80]!r}",
            fix=f"write points for the commas, for instance by: sed -i 's/,/./g' {files}",
        )
