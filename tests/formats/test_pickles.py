from __future__ import annotations

import pickle
import pickletools
import struct
import sys
from collections import OrderedDict
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bask_data.errors import BadData
from bask_data.formats import pickles
from bask_data.formats.pickles import Record, read_pickle

PLAIN = {
    "numbers": [1, -(2**70), 2.5, True, None, 300, 70000],
    "texts": ("a", "π" * 300, b"bytes", b""),
    "nested": {"x": [(1, (2, (3, ())))], 7: {}},
}

ARRAYS = {
    "matrix": np.arange(6.0).reshape(2, 3),
    "by column": np.asfortranarray(np.arange(6.0).reshape(2, 3)),
    "big-endian": np.arange(3, dtype=">i4"),
    "flags": np.array([True, False]),
    "none": np.zeros((0, 3), np.float32),
    "number": np.array(2.5),
    "scalar": np.float64(3.5),
}


class Runs:
    """Whoever unpickles it calls a function."""

    def __init__(self, function: Any, *arguments: Any) -> None:
        self.called = function, arguments

    def __reduce__(self) -> Any:
        return self.called


class Pose:
    """A class that the reader is told of."""


def written(path: Path, value: Any, protocol: int = 4) -> Path:
    path.write_bytes(pickle.dumps(value, protocol))
    return path


@pytest.mark.parametrize("protocol", [2, 3, 4, 5])
def test_plain_data_and_arrays_are_read_as_pickle_reads_them(tmp_path: Path, protocol: int) -> None:
    shared = np.arange(4)
    value = {**PLAIN, "shared": [shared, (shared, {"again": shared})]}
    found = read_pickle(written(tmp_path / "a.pkl", value, protocol))
    assert {name: found[name] for name in PLAIN} == PLAIN
    first, (second, third) = found["shared"]
    assert first is second is third["again"] and first.tolist() == [0, 1, 2, 3]
    arrays = read_pickle(written(tmp_path / "b.pkl", ARRAYS, protocol))
    assert arrays.keys() == ARRAYS.keys()
    for name, array in ARRAYS.items():
        np.testing.assert_array_equal(arrays[name], array)
        assert np.asarray(arrays[name]).dtype == array.dtype


def test_arrays_written_by_numpy_before_version_2_are_read(tmp_path: Path) -> None:
    data = pickle.dumps([np.arange(3.0), np.float32(1.5)], 4)
    old = pickletools.optimize(data).replace(b"\x8c\x16numpy._core.multiarray", b"\x8c\x15numpy.core.multiarray")
    (tmp_path / "a.pkl").write_bytes(b"\x80\x04" + old[old.index(b"]") :])
    array, number = read_pickle(tmp_path / "a.pkl")
    assert array.tolist() == [0, 1, 2] and number == 1.5


@pytest.mark.parametrize("protocol", [2, 4])
def test_objects_of_named_classes_become_records(tmp_path: Path, protocol: int) -> None:
    pose = Pose()
    pose.at, pose.parent = np.zeros(3), None  # type: ignore[attr-defined]
    file = written(tmp_path / "a.pkl", [pose], protocol)
    [record] = read_pickle(file, (f"{__name__}.Pose",))
    assert isinstance(record, Record) and record.kind == "Pose" and record.attributes["at"].tolist() == [0, 0, 0]
    with pytest.raises(BadData, match=rf"a\.pkl: expected a pickle of plain data .*, got the name '{__name__}\.Pose'"):
        read_pickle(file)


@pytest.mark.parametrize("protocol", [0, 1, 2, 3, 4, 5])
def test_nothing_is_run(tmp_path: Path, protocol: int) -> None:
    import os

    ran = tmp_path / "ran"
    for value in (
        Runs(os.system, f"touch {ran}"),
        Runs(eval, f"open({str(ran)!r}, 'w')"),
        Runs(getattr, Path, "touch"),
        [1, {"deep": (Runs(Path.touch, ran),)}],
        np.array([Runs(os.system, f"touch {ran}")], dtype=object),
    ):
        with pytest.raises(BadData, match="nothing of it was run"):
            read_pickle(written(tmp_path / "a.pkl", value, protocol))
    assert not ran.exists()


def refused(tmp_path: Path, data: bytes, why: str) -> None:
    (tmp_path / "a.pkl").write_bytes(data)
    with pytest.raises(BadData, match=why):
        read_pickle(tmp_path / "a.pkl", (f"{__name__}.Pose",))


def named(module: str, name: str) -> bytes:
    return f"c{module}\n{name}\n".encode()


def test_other_values_than_numbers_in_arrays_are_refused(tmp_path: Path) -> None:
    refused(tmp_path, pickle.dumps(np.array([1, "a"], dtype=object)), "an array of objects")
    refused(tmp_path, pickle.dumps(np.zeros(2, [("x", "f4")])), "something else than numbers|a state")
    refused(tmp_path, pickle.dumps(np.array(["text"])), "something else than numbers")
    refused(tmp_path, pickle.dumps(np.ma.zeros(2)), "the name 'numpy.ma.core._mareconstruct'")
    refused(tmp_path, pickle.dumps(OrderedDict(a=1)), "the name 'collections.OrderedDict'")


def test_arrays_that_claim_more_than_they_hold_are_refused(tmp_path: Path) -> None:
    data = pickle.dumps(np.arange(3, dtype=np.uint8), 2)
    assert data.count(b"K\x03\x85") == 1
    refused(tmp_path, data.replace(b"K\x03\x85", b"J\xff\xff\xff\x7f\x85"), "content is of another size")
    refused(tmp_path, data.replace(b"K\x03\x85", b"J\xff\xff\xff\xff\x85"), "an array of impossible shape")


def test_small_files_do_not_take_much_memory_or_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    huge = struct.pack("<Q", 2**60)
    refused(tmp_path, b"\x80\x05\x96" + huge + b"x.", "a complete pickle")  # BYTEARRAY8
    refused(tmp_path, b"\x80\x04\x8e" + huge + b"x.", "a complete pickle")  # BINBYTES8
    refused(tmp_path, b"\x80\x04\x8b\xff\xff\xff\x7f1.", "a complete pickle")  # LONG4
    (tmp_path / "a.pkl").write_bytes(b"\x80\x04Nr\xff\xff\xff\x7f.")  # LONG_BINPUT, a memo of 2^31 entries
    assert read_pickle(tmp_path / "a.pkl") is None
    # Each tuple holds the one before it twice; as a key it would be hashed 2^60 times.
    nested = b")" + b"q\x00h\x00\x86" * 60
    refused(tmp_path, b"\x80\x04}" + nested + b"Ns.", "a key of type tuple")
    deep = 100_000
    assert deep > sys.getrecursionlimit()
    (tmp_path / "a.pkl").write_bytes(b"\x80\x04)" + b"\x85" * deep + b".")
    assert isinstance(read_pickle(tmp_path / "a.pkl"), tuple)
    monkeypatch.setattr(pickles, "MAX_OPCODES", 1000)
    refused(tmp_path, b"\x80\x04" + b"N" * 1001 + b".", "more than 1000 operations")
    monkeypatch.setattr(pickles, "MAX_PICKLE_BYTES", 100)
    refused(tmp_path, b"\x80\x04C\x80" + b"N" * 128 + b".", "size: expected at most 100 bytes")


def test_opcodes_that_plain_data_do_not_need_are_refused(tmp_path: Path) -> None:
    refused(tmp_path, b"\x80\x02K\x01Q.", "operation BINPERSID")
    refused(tmp_path, b"\x80\x02\x82\x01.", "operation EXT1")
    refused(tmp_path, b"(ios\nsystem\n.", "operation INST")
    refused(tmp_path, b"\x80\x05\x97.", "operation NEXT_BUFFER")
    refused(tmp_path, b"\x80\x02" + named("numpy", "dtype") + b")\x81.", "an object of numpy.dtype")
    refused(tmp_path, b"\x80\x02]}b.", "a state for something that has none")
    refused(tmp_path, b"\x80\x02](K\x01K\x02u.", "items for something else than a dict")
    refused(tmp_path, b"\x80\x02]K\x01R.", "a call of something else than a name")


def test_damaged_pickles_are_refused(tmp_path: Path) -> None:
    data = pickle.dumps([1, 2, np.zeros(3)], 4)
    for cut in (data[: len(data) // 2], b"\x80\x04" + b"\xff" * 9, b"\x80\x04.", b"\x80\x04e.", b"text"):
        (tmp_path / "a.pkl").write_bytes(cut)
        with pytest.raises(BadData, match="expected a"):
            read_pickle(tmp_path / "a.pkl")
