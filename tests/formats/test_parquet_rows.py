from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from bask_data.errors import BadData
from bask_data.formats import parquet_rows, parquet_values
from bask_data.formats.parquet_rows import ParquetRows
from bask_data.formats.parquet_values import RowValues

N = 11


def written(path: Path, row_group_size: int = 4, **columns: object) -> Path:
    pq.write_table(pa.table({name.replace("__", "."): of for name, of in columns.items()}), path, row_group_size)
    return path


def image_files(n: int = N) -> pa.Array:
    kind = pa.struct([("bytes", pa.binary()), ("path", pa.string())])
    return pa.array([{"bytes": bytes([i]) * (i + 1), "path": f"{i}.png"} for i in range(n)], kind)


def test_numbers_and_lists_of_one_length_are_arrays_whatever_their_type(tmp_path: Path) -> None:
    values = np.arange(3.0 * N).reshape(N, 3)
    table = ParquetRows(
        written(
            tmp_path / "a.parquet",
            single=np.arange(N, dtype=np.int64),
            fixed=pa.FixedSizeListArray.from_arrays(pa.array(values.ravel()), 3),
            lists=pa.array(values.tolist(), pa.list_(pa.float32())),
            nested=pa.array(values.reshape(N, 1, 3).tolist(), pa.large_list(pa.list_(pa.float64()))),
            missing=pa.array([None, *range(1, N)], pa.float64()),
            flags=np.arange(N) % 2 == 0,
        )
    )
    assert table.n_rows == N
    np.testing.assert_array_equal(table.numbers("single"), np.arange(N))
    for name in ("fixed", "lists"):
        np.testing.assert_array_equal(table.numbers(name), values)
        np.testing.assert_array_equal(table.numbers(name, range(3, 9)), values[3:9])
    assert table.numbers("nested", range(10, 11)).tolist() == [[[30.0, 31.0, 32.0]]]
    assert np.isnan(table.numbers("missing")[0])
    assert table.numbers("flags").tolist() == [True, False] * 5 + [True]


def test_a_column_is_read_by_its_whole_name(tmp_path: Path) -> None:
    table = ParquetRows(written(tmp_path / "a.parquet", a__b=np.arange(N), a__b__c=-np.arange(N)))
    np.testing.assert_array_equal(table.numbers("a.b"), np.arange(N))
    with pytest.raises(BadData, match="a: expected a column of that name, got none"):
        table.numbers("a")


@pytest.mark.parametrize(
    ("column", "message"),
    [
        (pa.array([[1.0]] * 5 + [[1.0, 2.0]] * 6), "expected lists of one length"),
        (pa.array([[1.0]] * 5 + [None] * 6), "expected lists of one length"),
        (pa.array(["a"] * N), "expected numbers, got string"),
        (image_files(), "expected numbers, got struct"),
    ],
)
def test_columns_of_other_things_than_numbers_are_refused(tmp_path: Path, column: pa.Array, message: str) -> None:
    with pytest.raises(BadData, match=message):
        ParquetRows(written(tmp_path / "a.parquet", column=column)).numbers("column")


def test_types_that_a_program_would_restore_are_read_as_stored(tmp_path: Path) -> None:
    plain = pa.array(np.arange(N, dtype=np.float64))
    field = pa.field("x", plain.type, metadata={"ARROW:extension:name": "arrow.py_extension_type"})
    pq.write_table(pa.table([plain], schema=pa.schema([field])), tmp_path / "a.parquet")
    np.testing.assert_array_equal(ParquetRows(tmp_path / "a.parquet").numbers("x"), np.arange(N))


def test_damaged_files_and_pointers_to_content_are_refused(tmp_path: Path) -> None:
    whole = written(tmp_path / "a.parquet", x=np.random.default_rng(0).normal(size=1000)).read_bytes()
    contents = {
        "pointer": b"version https://git-lfs.github.com/spec/v1\noid sha256:00\n",
        "half": whole[: len(whole) // 2],
        "empty": b"",
        "flipped": whole[:300] + bytes([whole[300] ^ 255] * 40) + whole[340:],
    }
    for name, content in contents.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(BadData, match=f"{name}: .*expected a readable Parquet file"):
            ParquetRows(tmp_path / name).numbers("x")


def test_rows_and_values_beyond_the_bounds_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = written(tmp_path / "a.parquet", images=image_files(), x=np.ones(N), y=pa.array([[1.0] * 5] * N))
    monkeypatch.setattr(parquet_rows, "MAX_ROW", 4)
    with pytest.raises(BadData, match="y: expected at most 4 numbers in a row"):
        ParquetRows(path).numbers("y")
    monkeypatch.setattr(parquet_values, "MAX_VALUE_BYTES", 10)
    with pytest.raises(BadData, match="row 10: images: expected at most 10 bytes"):
        RowValues(path, "images").files_of(10)
    monkeypatch.setattr(parquet_rows, "MAX_ROWS", 10)
    with pytest.raises(BadData, match="rows: expected 0 to 10 rows, got 11"):
        ParquetRows(path)


@pytest.mark.parametrize("row_group_size", [1, 4, 100])
def test_values_are_read_in_any_order_and_together_with_others(tmp_path: Path, row_group_size: int) -> None:
    path = written(tmp_path / "a.parquet", row_group_size, images=image_files(), again=image_files(), x=np.arange(N))
    table, images, again = ParquetRows(path), RowValues(path, "images"), RowValues(path, "again")
    for i in (0, 0, 1, 5, 3, 10, 9, 10):
        assert images.files_of(i) == (bytes([i]) * (i + 1), f"{i}.png")
        assert table.numbers("x", range(i, N))[0] == i
        assert again.files_of(N - 1 - i) == (bytes([N - 1 - i]) * (N - i), f"{N - 1 - i}.png")
    with pytest.raises(BadData, match="row 11: images: expected a row below 11"):
        images.files_of(N)


def test_images_are_bytes_or_paths_alone_too(tmp_path: Path) -> None:
    columns = {"data": pa.array([b"x"] * N), "place": pa.array(["x.png"] * N), "number": np.ones(N)}
    path = written(tmp_path / "a.parquet", **columns)
    assert RowValues(path, "data").files_of(1) == (b"x", None)
    assert RowValues(path, "place").files_of(1) == (None, "x.png")
    with pytest.raises(BadData, match="number: expected an image file, got double"):
        RowValues(path, "number").files_of(1)
