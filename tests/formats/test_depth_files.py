from __future__ import annotations

import struct
import sys
import tracemalloc
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import pytest

from bask_data.errors import BadData, MissingDependency
from bask_data.formats.depth_files import read_any_depth
from bask_data.formats.tiff import tiff_header
from tests.formats.folders import HEIGHT, WIDTH, images, rigid, write_frames
from tests.formats.test_frames import read

METRES = np.where(images(1)[1][0] > 0, images(1)[1][0] / np.float32(1000), np.float32("nan")).astype(np.float32)


def write(path: Path, values: np.ndarray, **channels: str) -> Path:
    if path.suffix == ".npy":
        np.save(path, values)
    elif path.suffix == ".exr":
        named = dict.fromkeys(channels.get("names", "Z").split(","), values)
        OpenEXR.File({"type": OpenEXR.scanlineimage}, named).write(str(path))
    else:
        assert cv2.imwrite(str(path), values)
    return path


@pytest.mark.parametrize("suffix", [".npy", ".tiff", ".exr"])
def test_depth_in_metres_is_kept_and_what_is_no_measurement_becomes_zero(tmp_path: Path, suffix: str) -> None:
    values = METRES.copy()
    values[0, :4] = [np.inf, -1, 0, 1e10]
    depth = read_any_depth(write(tmp_path / f"d{suffix}", values))
    expected = np.where(np.isfinite(METRES), METRES, 0)
    expected[0, :4] = 0
    assert depth.dtype == np.float32 and np.array_equal(depth, expected)


@pytest.mark.parametrize("dtype", [np.float16, np.float64, np.uint16, np.int32, np.int64])
def test_arrays_of_every_kind_of_number_are_read(tmp_path: Path, dtype: type) -> None:
    values = images(1)[1][0].astype(dtype)
    depth = read_any_depth(write(tmp_path / "d.npy", values[None] if dtype == np.int32 else values[..., None]))
    assert depth.dtype == (np.float32 if np.issubdtype(dtype, np.floating) else np.uint16)
    assert np.array_equal(depth, values)


def test_sixteen_bit_tiff_and_half_precision_exr_are_read(tmp_path: Path) -> None:
    raw = images(1)[1][0]
    assert np.array_equal(read_any_depth(write(tmp_path / "d.tif", raw)), raw)
    half = read_any_depth(write(tmp_path / "d.exr", METRES.astype(np.float16), names="R,G,B"))
    assert np.nanmax(np.abs(half - METRES)) < 1e-3


def broken(folder: Path) -> dict[str, Path]:
    whole = {suffix: write(folder / f"w{suffix}", METRES).read_bytes() for suffix in (".npy", ".tiff", ".exr")}
    np.save(folder / "objects.npy", np.array([{}, 1], dtype=object), allow_pickle=True)
    header = whole[".npy"].replace(b"(12, 16), }    ", b"(120000, 16), }")
    cut = {f"cut{suffix}": data[: len(data) - 200] for suffix, data in whole.items()}
    for name, data in {"claims.npy": header, "negative.npy": b"\x93NUMPY\1\0\xff\xff" + b"(" * 900, **cut}.items():
        (folder / name).write_bytes(data)
    np.save(folder / "signed.npy", np.array([[-1, 5]], np.int32))
    np.save(folder / "stack.npy", np.zeros((3, 4, 5), np.float32))
    OpenEXR.File({}, {"R": METRES, "G": METRES * 2}).write(str(folder / "two.exr"))
    OpenEXR.File({}, {"Z": np.ones((HEIGHT, WIDTH), np.uint32)}).write(str(folder / "whole.exr"))
    cv2.imwrite(str(folder / "three.tiff"), np.dstack([METRES] * 3))
    return {path.name: path for path in folder.iterdir()}


BROKEN = {
    "objects.npy": "array: expected numbers saved by numpy.save",
    "claims.npy": "array: expected numbers saved by numpy.save",
    "negative.npy": "array: expected numbers saved by numpy.save",
    "cut.npy": "array: expected numbers saved by numpy.save",
    "cut.tiff": "truncated or corrupted",
    "cut.exr": "expected a readable EXR",
    "signed.npy": "expected whole numbers from 0 to 65535, got -1 to 5",
    "stack.npy": r"expected one channel, of 16 bits or in floating point, got an array \(3, 4, 5\)",
    "two.exr": "expected one channel, of 16 bits or in floating point, got channels G, R",
    "whole.exr": "expected one channel, of 16 bits or in floating point, got .* of uint32",
    "three.tiff": "expected one channel, of 16 bits or in floating point, got 3 of 32 bits",
}


def test_entries_of_a_tiff_that_nobody_asks_for_are_not_read(tmp_path: Path) -> None:
    file = write(tmp_path / "a.tiff", METRES)
    data = bytearray(file.read_bytes())
    begin = int.from_bytes(data[4:8], "little")
    n = int.from_bytes(data[begin : begin + 2], "little")
    entries = data[begin + 2 : begin + 2 + 12 * n]
    # More entries, each with as many bytes as the file has.
    many = b"".join(struct.pack("<HHII", 40_000 + i, 1, 10**4, 8) for i in range(900))
    data[4:8] = struct.pack("<I", len(data))
    data += struct.pack("<H", n + 900) + entries + many + bytes(4)
    file.write_bytes(data + bytes(10**4))
    content = file.read_bytes()
    tracemalloc.start()
    assert tiff_header(file, content).width == METRES.shape[1]
    assert tracemalloc.get_traced_memory()[1] < 10**6
    tracemalloc.stop()


@pytest.mark.parametrize("name", BROKEN)
def test_a_file_that_is_no_depth_image_is_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(BadData, match=f"{name}: .*{BROKEN[name]}"):
        read_any_depth(broken(tmp_path)[name])


def test_a_missing_library_is_named_with_its_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write(tmp_path / "d.exr", METRES)
    monkeypatch.setitem(sys.modules, "OpenEXR", None)
    with pytest.raises(MissingDependency, match=r"pip install 'bask-data\[formats\]'"):
        read_any_depth(path)


@pytest.mark.parametrize(
    ("suffix", "scale", "expected"), [(".npy", None, 1.0), (".tiff", None, 1.0), (".npy", 0.5, 0.5)]
)
def test_frames_take_floating_point_for_metres_unless_told_otherwise(
    tmp_path: Path, suffix: str, scale: float | None, expected: float
) -> None:
    write_frames(tmp_path, rigid(np.random.default_rng(0))[None])
    write(tmp_path / f"frame-000000.depth{suffix}", METRES)
    recording = read(tmp_path, depth=f"frame-*.depth{suffix}", depth_scale=scale)
    (camera,) = recording.cameras
    metres = np.where(np.isfinite(METRES), METRES, 0) * expected
    assert np.abs(camera.read(0)[1] * camera.depth_scale - metres).max() <= camera.depth_scale / 2 + 1e-7
    assert f"{expected:g} m per unit" in recording.assumptions["depth"]


def test_whole_numbers_among_floating_point_are_refused(tmp_path: Path) -> None:
    write_frames(tmp_path, np.stack([np.eye(4)] * 2))
    write(tmp_path / "frame-000000.depth.npy", METRES)
    write(tmp_path / "frame-000001.depth.npy", images(1)[1][0])
    with pytest.raises(BadData, match="000001.depth.npy: depth: expected floating point as in frame-000000.depth.npy"):
        read(tmp_path, depth="frame-*.depth.npy")
