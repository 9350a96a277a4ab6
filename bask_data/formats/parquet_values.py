"""Values of a Parquet column that are too large to be read at once, such as images: one at a time."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pyarrow as pa
from jaxtyping import Shaped
from numpy import ndarray

from bask_data.errors import BadData
from bask_data.formats.parquet_rows import ParquetRows

MAX_VALUE_BYTES = 512 * 2**20
"""Largest value of one row, bytes: more than an image of `MAX_PIXELS` takes."""


class RowValues:
    """The values of a column, one at a time: ascending order is fastest. A value is held as Arrow has it.

    The rows of a group are decoded one after the other, so a row before the last one costs its group's beginning again.
    """

    def __init__(self, path: Path, column: str) -> None:
        """Prepare reading.

        Raises:
            BadData: not a readable Parquet file, or there is no such column.
        """
        # A reader of its own: PyArrow's has one size of pieces for all columns that are being read.
        self._table, self._column = ParquetRows(path), column
        self._table.index(column)
        self._next = 0
        self._rows: Iterator[tuple[int, pa.Array]] = iter(())
        self._last: tuple[int, pa.Array] | None = None

    def files_of(self, row: int) -> tuple[bytes | None, str | None]:
        """Bytes and path of an image file, either of which may be missing; `BadData` for anything else."""
        array = self._at(row)
        kind = array.type
        if pa.types.is_struct(kind) and kind.get_field_index("bytes") >= 0:
            value = array[0].as_py() or {}
            data, path = value.get("bytes"), value.get("path")
        elif pa.types.is_binary(kind) or pa.types.is_large_binary(kind):
            data, path = array[0].as_py(), None
        elif pa.types.is_string(kind) or pa.types.is_large_string(kind):
            data, path = None, array[0].as_py()
        else:
            raise BadData(self._place(row), self._column, expected="an image file", got=str(kind))
        if not (data is None or isinstance(data, bytes)) or not (path is None or isinstance(path, str)):
            raise BadData(self._place(row), self._column, expected="bytes and path of an image", got=str(kind))
        return data or None, path or None

    def array(self, row: int) -> Shaped[ndarray, "*shape"]:
        """The numbers of a row, as they are nested; `BadData` if they are none."""
        values: ndarray = self._table.dense(self._column, row, self._at(row))[0]
        return values

    def _place(self, row: int) -> str:
        return f"{self._table.path}: row {row}"

    def _at(self, row: int) -> pa.Array:
        if self._last is not None and self._last[0] == row:
            return self._last[1]
        if row < self._next or self._next == 0 or row - self._next > self._table.n_rows:
            self._rows = self._table.batches(self._column, range(row, self._table.n_rows), 1)
        self._last = None
        found = next((piece for piece in self._rows if piece[0] >= row), None)
        if found is None or found[0] != row:
            raise BadData(self._place(row), self._column, expected=f"a row below {self._table.n_rows}", got="none")
        if found[1].nbytes > MAX_VALUE_BYTES:
            raise BadData(
                self._place(row), self._column, expected=f"at most {MAX_VALUE_BYTES} bytes", got=found[1].nbytes
            )
        self._last, self._next = found, row + 1
        return found[1]
