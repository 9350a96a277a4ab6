"""Columns of numbers of an episode, by name, or a part of one: `observation.state[0:7]`."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from bask_data.errors import BadData, UsageError
from bask_data.formats.files import listed
from bask_data.formats.lerobot.info import Info
from bask_data.formats.parquet_rows import ParquetRows

_PART = re.compile(r"(?P<column>.+?)(?:\[(?P<first>[^\[\]:]+)(?::(?P<end>[^\[\]:]+))?\])?")

POSE_WIDTHS = (16, 12, 7)
"""Numbers of a pose: a 4x4 or 3x4 matrix, or a position and a quaternion."""


@dataclass(frozen=True)
class EpisodeRows:
    """The rows of one episode in its table.

    Args:
        rows: their numbers in the file.
    """

    info: Info
    table: ParquetRows
    rows: range

    @property
    def n_frames(self) -> int:
        """Number of frames."""
        return len(self.rows)

    def has(self, column: str) -> bool:
        """Whether there is a column of this name."""
        return self.table.has(column)

    def column(self, name: str) -> Float[ndarray, "t n"]:
        """The numbers of a column, those of a matrix row by row."""
        return self.table.numbers(name, self.rows).astype(np.float64).reshape(self.n_frames, -1)

    def part(self, option: str, text: str) -> Float[ndarray, "t n"]:
        """The numbers of COLUMN, COLUMN[i], COLUMN[i:j], where i and j may be names of values, j not included.

        Raises:
            UsageError: there is no such column or value.
        """
        match = _PART.fullmatch(text)
        name = match["column"] if match else text
        if match is None or not self.has(name) or name not in self.numeric:
            known = listed(sorted(self.numeric), 12)
            raise UsageError(option, expected=f"a column of numbers: {known}", got=text, fix="see meta/info.json.")
        values = self.column(name)
        if match["first"] is None:
            return values
        first = self._place(option, name, match["first"], values.shape[1])
        end = first + 1 if match["end"] is None else self._place(option, name, match["end"], values.shape[1] + 1)
        if not first < end:
            raise UsageError(option, expected="a part that begins before it ends", got=text)
        return values[:, first:end]

    @property
    def numeric(self) -> list[str]:
        """Names of the features that hold numbers."""
        return [
            key for key, of in self.info.features.items() if not of.is_visual and of.dtype not in ("string", "language")
        ]

    def named(self, column: str) -> tuple[str, ...]:
        """Names of a column's values; empty if they have none."""
        feature = self.info.features.get(column)
        return feature.names if feature else ()

    def _place(self, option: str, column: str, text: str, n: int) -> int:
        names = self.named(column)
        place = int(text) if text.isdecimal() else names.index(text) if text in names else -1
        if not 0 <= place < n:
            raise UsageError(
                option,
                expected=f"a value of {column}: 0 to {n - 1}" + (f", or {listed(names, 12)}" if names else ""),
                got=text,
                fix="see `names` in meta/info.json.",
            )
        return place


def episode_rows(info: Info, table: ParquetRows, index: int, length: int) -> EpisodeRows:
    """The rows of an episode, which lie together.

    Raises:
        BadData: there are none, they are scattered, or their number is not that of the list of episodes.
    """
    rows = (table.numbers("episode_index").reshape(-1) == index).nonzero()[0]
    if len(rows) == 0 or len(rows) != length or rows[-1] - rows[0] != len(rows) - 1:
        raise BadData(
            table.path,
            "episode_index",
            expected=f"{length} rows of episode {index}, one after another",
            got=f"{len(rows)}" + (" scattered ones" if len(rows) == length and len(rows) else ""),
            fix="copy the dataset again: its tables do not belong to its meta/.",
        )
    return EpisodeRows(info, table, range(int(rows[0]), int(rows[-1]) + 1))
