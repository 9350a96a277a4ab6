"""Files with the poses of many frames: one per line, as blocks of a matrix, or as a NumPy array."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from bask_data.errors import BadData
from bask_data.formats.arrays import read_npy
from bask_data.formats.files import frame_number, is_number, numbered_lines, numbers, without_header, words_of
from bask_data.formats.poses import parse_transform

POSE_LENGTHS = (7, 12, 16)
"""Numbers of a pose in one line: a quaternion, a 3x4 or a 4x4 matrix. One more is the frame's number or time."""

MAX_POSES = 2_000_000
"""Poses read from a NumPy array: 18 hours at 30 per second. Keeps wrong files from filling memory."""


@dataclass(frozen=True)
class PoseLayout:
    """How poses are written: order of quaternions, and whether matrices are written column by column."""

    quat: str = "xyzw"
    column_major: bool = False


@dataclass(frozen=True)
class Trajectory:
    """The poses in a file, as written.

    Args:
        poses: transforms, not checked; may hold NaN.
        keys: the number, time or name before each pose, as written; empty if the file has none.
        lines: line of each pose, from 1; counted from 1 where the file has no lines.
        quaternions: whether rotations are quaternions.
        in_blocks: whether poses take several lines each.
    """

    path: Path
    poses: Float[ndarray, "t 4 4"]
    keys: tuple[str, ...]
    lines: tuple[int, ...]
    quaternions: bool = False
    in_blocks: bool = False

    def place(self, i: int) -> str:
        """Where a pose stands, for messages."""
        return f"{self.path}: line {self.lines[i]}"

    @property
    def stamps(self) -> ndarray:
        """The keys as numbers: integers where all are, as nanoseconds since 1970 need them.

        Raises:
            BadData: they are names.
        """
        try:
            return stamps_of(self.keys)
        except ValueError as error:
            raise BadData(
                self.path,
                "time",
                expected="lines that begin with times",
                got=str(error)[:100],
                fix="write the time of each pose before it.",
            ) from error

    @property
    def numbers(self) -> list[int | None]:
        """The frame's number in each key: the key itself, or the last number in the name of a file; None without."""
        return [_number_in(key) for key in self.keys]


def _number_in(key: str) -> int | None:
    if not is_number(key):
        return frame_number(PurePosixPath(key).stem)
    if key.isdecimal():
        return int(key)  # Nanoseconds since 1970 have more digits than a float.
    value = float(key)
    return int(value) if np.isfinite(value) and value == np.rint(value) else None


def stamps_of(words: tuple[str, ...] | list[str]) -> ndarray:
    """Numbers as written, whole ones with all their digits.

    Raises:
        ValueError: a word is no number.
    """
    try:
        return np.array([int(word) for word in words], dtype=np.int64)
    except (ValueError, OverflowError):
        return np.array([float(word) for word in words], dtype=np.float64)


def read_trajectory(path: Path, layout: PoseLayout) -> Trajectory:
    """The poses in a file: a pose per line, with a number, a time or a name before it or not; matrices of 4 or 3 lines,
    with a line before each (Open3D's `.log`) or not; or an array (t, 4, 4) of NumPy.

    Raises:
        BadData: the file is none of these, or a quaternion's length is not 1.
    """
    if path.suffix.lower() == ".npy":
        return _of_array(path, layout)
    lines = [(i, line) for i, line in without_header(numbered_lines(path)) if words_of(line)]  # Brackets may be alone.
    names = [words_of(line)[0] for _, line in lines]
    if lines and not any(map(is_number, names)):
        return _of_named_lines(path, lines, names, layout)
    rows = [numbers(path, line) for _, line in lines]
    lengths = {len(row) for row in rows}
    if lengths == {4} or (len(rows) >= 4 and len(rows[0]) <= 4 and lengths <= {1, 2, 3, 4}):
        return _of_blocks(path, rows, [i for i, _ in lines], layout)
    if len(lengths) == 1 and (length := lengths.pop()) in (*POSE_LENGTHS, *(n + 1 for n in POSE_LENGTHS)):
        has_key = length not in POSE_LENGTHS
        numbered = [(i, row[1:] if has_key else row) for (i, _), row in zip(lines, rows, strict=True)]
        return Trajectory(
            path,
            np.stack([_transform(f"{path}: line {i}", row, layout) for i, row in numbered]),
            tuple(names) if has_key else (),
            tuple(i for i, _ in numbered),
            quaternions=length - has_key == 7,
        )
    odd = next((i for i, row in enumerate(rows) if len(row) != len(rows[0])), 0)
    raise BadData(
        path,
        "pose",
        expected="lines of 7, 12 or 16 numbers, with a number or a time before them or not, or blocks of 4 lines of 4",
        got=f"{len(rows[odd])} numbers in line {lines[odd][0]}, {len(rows[0])} in the first" if rows else "no lines",
        fix="check that this is the file of the poses.",
    )


def _of_named_lines(path: Path, lines: list[tuple[int, str]], names: list[str], layout: PoseLayout) -> Trajectory:
    """A pose per line, after the name of its image."""
    rows = [numbers(path, line[len(name) :].lstrip(" ,;\t")) for (_, line), name in zip(lines, names, strict=True)]
    poses = [_transform(f"{path}: line {i}", row, layout) for (i, _), row in zip(lines, rows, strict=True)]
    return Trajectory(path, np.stack(poses), tuple(names), tuple(i for i, _ in lines), len(rows[0]) == 7)


def _transform(where: str, values: list[float], layout: PoseLayout) -> Float[ndarray, "4 4"]:
    return parse_transform(where, values, layout.quat, layout.column_major)


def _of_blocks(path: Path, rows: list[list[float]], lines: list[int], layout: PoseLayout) -> Trajectory:
    """Matrices over several lines, each after a line that begins with the frame's number, or not."""
    has_key = len(rows[0]) < 4
    height = next((n for n in (4, 3) if _is_in_blocks(rows, n, has_key)), 0)
    if not height:
        raise BadData(
            path,
            "pose",
            expected="blocks of 4 lines of 4 numbers, each with a line before it (`0 0 1`) or not",
            got=f"{len(rows)} lines of {', '.join(map(str, sorted({len(row) for row in rows})))} numbers",
            fix="check that this is the file of the poses.",
        )
    step = height + has_key
    begins = range(0, len(rows), step)
    blocks = [[value for row in rows[i + has_key : i + step] for value in row] for i in begins]
    return Trajectory(
        path,
        np.stack([_transform(f"{path}: line {lines[i]}", b, layout) for i, b in zip(begins, blocks, strict=True)]),
        tuple(f"{rows[i][0]:g}" for i in begins) if has_key else (),
        tuple(lines[i] for i in begins),
        in_blocks=True,
    )


def _is_in_blocks(rows: list[list[float]], height: int, has_key: bool) -> bool:
    step = height + has_key
    if len(rows) % step:
        return False
    whole = all((len(row) < 4) == (has_key and i % step == 0) for i, row in enumerate(rows))
    last = [rows[i] for i in range(step - 1, len(rows), step)]
    # Blocks of four lines end in 0 0 0 1, or are transposed; twelve lines are also four blocks of three.
    return whole and (height == 3 or all(row[3] == 1 or not np.isfinite(row).all() for row in last))


def _of_array(path: Path, layout: PoseLayout) -> Trajectory:
    array = read_npy(path, MAX_POSES * 16)
    flat = array.reshape(len(array), -1) if array.ndim in (2, 3) and len(array) else array.reshape(1, -1)
    if array.ndim == 2 and array.shape == (4, 4):
        flat = array.reshape(1, 16)
    if not np.issubdtype(array.dtype, np.number) or flat.shape[1] not in POSE_LENGTHS:
        raise BadData(
            path,
            "pose",
            expected="an array (t, 4, 4), (t, 3, 4) or (t, 7) of numbers",
            got=f"{array.shape} of {array.dtype}",
            fix="save it with numpy.save(FILE, poses).",
        )
    places = [f"{path}: pose {i + 1}" for i in range(len(flat))]
    return Trajectory(
        path,
        np.stack([_transform(place, [float(x) for x in row], layout) for place, row in zip(places, flat, strict=True)]),
        (),
        tuple(range(1, len(flat) + 1)),
        quaternions=flat.shape[1] == 7,
    )
