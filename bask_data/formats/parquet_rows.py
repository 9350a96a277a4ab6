"""Rows of Parquet files, of which any may come from a stranger: bounded, and images one row at a time.

Types that only a program could restore (extension types) are read as what they are stored as; nothing is run.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Shaped
from numpy import ndarray

from bask_data.errors import BadData

MAX_ROWS = 50_000_000
"""Most rows of a file: a week at 80 frames per second. A small file may claim any number."""

MAX_ROW = 100_000
"""Most numbers in a row of a column that is read as a whole: tactile arrays have some thousand."""

MAX_NUMBERS = 500_000_000
"""Most numbers of a column that is read as a whole: 4 GB as float64."""

TEXTS_AT_ONCE = 16
"""Rows of texts that are decoded at a time."""

BUFFER = 2**20
"""Bytes of a column that are read from the file at a time."""

MAX_NESTING = 4
"""Lists within lists; arrays of images have three dimensions."""


class ParquetRows:
    """The rows of one Parquet file.

    Raises:
        BadData: not a readable Parquet file, or one with more than `MAX_ROWS`.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self._file = pq.ParquetFile(
                path, memory_map=False, pre_buffer=False, buffer_size=BUFFER, page_checksum_verification=True
            )
            self.schema = self._file.schema_arrow
        except (pa.ArrowException, OSError, ValueError) as error:
            raise self._unreadable(error) from error
        metadata = self._file.metadata
        counts = [metadata.row_group(g).num_rows for g in range(metadata.num_row_groups)]
        self._begins = np.concatenate([[0], np.cumsum(counts, dtype=np.int64)])
        self.n_rows = int(self._begins[-1])
        if min(counts, default=0) < 0 or self.n_rows > MAX_ROWS:
            raise BadData(path, "rows", expected=f"0 to {MAX_ROWS} rows", got=self.n_rows)

    def has(self, column: str) -> bool:
        """Whether there is exactly one column of this name."""
        return self.schema.get_field_index(column) >= 0

    def numbers(self, column: str, rows: range | None = None) -> Shaped[ndarray, "n *shape"]:
        """A column of numbers, or of lists of numbers of one length; NaN where a number is missing.

        Raises:
            BadData: there is no such column, it holds something else, or too much.
        """
        rows = range(self.n_rows) if rows is None else rows
        parts: list[ndarray] = []
        n_numbers = 0
        for begin, array in self.batches(column, rows, 1024):
            part = self.dense(column, begin, array)
            n_numbers += part.size
            if n_numbers > MAX_NUMBERS or part[0].size > MAX_ROW:
                raise BadData(self.path, column, expected=f"at most {MAX_ROW} numbers in a row", got=part.shape)
            if parts and part.shape[1:] != parts[0].shape[1:]:
                raise self._uneven(column, begin)
            parts.append(part)
        return np.concatenate(parts) if parts else np.zeros(0)

    def values(self, column: str, rows: range | None = None) -> list[Any]:
        """A column as Python values: texts, lists of texts."""
        rows = range(self.n_rows) if rows is None else rows
        # A text of one row may be as long as the file, and stand in every row.
        return [value for _, array in self.batches(column, rows, TEXTS_AT_ONCE) for value in array.to_pylist()]

    def index(self, column: str) -> int:
        """Number of a column; `BadData` if there is not exactly one of this name."""
        index = self.schema.get_field_index(column)
        if index < 0:
            raise BadData(
                self.path,
                column,
                expected="a column of that name",
                got="none",
                fix="check the names of columns.",
            )
        return int(index)

    def batches(self, column: str, rows: range, size: int) -> Iterator[tuple[int, pa.Array]]:
        """Pieces of a column, each with the number of its first row."""
        index = self.index(column)
        first = int(np.searchsorted(self._begins, rows.start, side="right")) - 1
        last = int(np.searchsorted(self._begins, rows.stop, side="left"))
        at = int(self._begins[first])
        try:
            for batch in self._file.iter_batches(
                size, row_groups=list(range(first, last)), columns=[column], use_threads=False
            ):
                array = batch.column(batch.schema.get_field_index(self.schema.field(index).name))
                begin, end = max(rows.start - at, 0), min(rows.stop - at, len(array))
                if begin < end:
                    yield at + begin, array.slice(begin, end - begin)
                at += len(array)
                if at >= rows.stop:
                    return
        except (pa.ArrowException, OSError, ValueError) as error:
            raise self._unreadable(error, column) from error

    def dense(self, column: str, begin: int, array: pa.Array) -> ndarray:
        """A piece of a column of numbers as an array."""
        shape = [len(array)]
        for _ in range(MAX_NESTING):
            if isinstance(array, pa.ExtensionArray):
                array = array.storage
            if not _is_list(array.type):
                break
            lengths = _lengths(array)
            if array.null_count or len(np.unique(lengths)) > 1:
                raise self._uneven(column, begin)
            shape.append(int(lengths[0]) if len(lengths) else 0)
            array = array.flatten()
        kind = array.type
        if not (pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_boolean(kind)):
            raise BadData(self.path, column, expected="numbers", got=str(kind), fix="choose another column.")
        return np.asarray(array.to_numpy(zero_copy_only=False)).reshape(shape)

    def _uneven(self, column: str, row: int) -> BadData:
        return BadData(
            self.path,
            f"{column} of the rows from {row}",
            expected="lists of one length",
            got="lists of several lengths, or none",
            fix="choose another column.",
        )

    def _unreadable(self, error: Exception, column: str = "") -> BadData:
        return BadData(
            self.path,
            column,
            expected="a readable Parquet file",
            got=str(error).splitlines()[0][:200] if str(error) else type(error).__name__,
            fix="copy it again from its source; `git lfs pull` if it is a pointer to the content.",
        )


def _is_list(kind: pa.DataType) -> bool:
    return bool(pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind))


def _lengths(array: pa.Array) -> ndarray:
    if pa.types.is_fixed_size_list(array.type):
        return np.full(len(array), array.type.list_size)
    return np.diff(array.offsets.to_numpy(zero_copy_only=False))
