from __future__ import annotations

import zlib
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from numpy import ndarray

from bask_data.errors import BadData, UsageError
from bask_data.formats import hdf5
from bask_data.formats.hdf5 import Hdf5File, hdf5_source
from bask_data.formats.hdf5 import storage as hdf5_storage

VALUES = np.arange(5 * 6 * 4, dtype=np.float32).reshape(5, 6, 4)
SHAPE = (None, None, None)


def written(path: Path, **options: Any) -> Path:
    with h5py.File(path, "w") as file:
        file.create_dataset("a/values", data=VALUES, **options)
    return path


def all_frames(file: Path, place: str = "a/values") -> ndarray:
    frames = Hdf5File(file).frames(place, SHAPE)
    return np.stack([frames(i) for i in range(len(frames))])


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"chunks": (1, 6, 4)},
        {"chunks": (2, 4, 3), "compression": "gzip", "shuffle": True, "fletcher32": True},
        {"chunks": (3, 6, 4), "compression": "lzf"},
        {"chunks": (5, 6, 4), "compression": "gzip"},
    ],
)
def test_frames_are_read_one_by_one_however_they_are_stored(tmp_path: Path, options: dict[str, Any]) -> None:
    file = written(tmp_path / "a.h5", **options)
    np.testing.assert_array_equal(all_frames(file), VALUES)
    frames = Hdf5File(file).frames("a/values", (None, 6, 4), kinds="f")
    np.testing.assert_array_equal([frames(i) for i in (4, 0, 3, 1)], VALUES[[4, 0, 3, 1]])
    np.testing.assert_array_equal(Hdf5File(file).array("/a/values/", SHAPE), VALUES)


def test_a_bounded_number_of_blocks_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = written(tmp_path / "a.h5", chunks=(2, 6, 4), compression="gzip")
    monkeypatch.setattr(hdf5, "MAX_KEPT_BYTES", 2 * 2 * 6 * 4 * 4)
    frames = Hdf5File(file).frames("a/values", SHAPE)
    reads: list[range | None] = []
    read = Hdf5File.read
    monkeypatch.setattr(
        Hdf5File, "read", lambda self, *arguments: reads.append(arguments[-1]) or read(self, *arguments)
    )
    for i in (0, 1, 2, 0, 3, 4, 0, 2):
        np.testing.assert_array_equal(frames(i), VALUES[i])
    assert [rows.start for rows in reads if rows] == [0, 2, 4, 0, 2]


def test_members_are_listed_in_natural_order_without_hidden_ones(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for name in ("demo_10", "demo_9", ".hidden"):
            file.create_group(f"data/{name}")
    opened = Hdf5File(tmp_path / "a.h5")
    assert opened.members("data") == ["demo_9", "demo_10"]
    assert opened.is_group("data/demo_9") and not opened.has("data/demo_11") and not opened.has("data/demo_9/obs")
    with pytest.raises(BadData, match=r"a\.h5: data: expected a member demo_1, got demo_9, demo_10\."):
        opened.array("data/demo_1", ())


def test_attributes_are_texts_or_numbers(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.attrs.update(
            {"text": "π", "bytes": np.bytes_(b"abc"), "number": 8, "list": [1, 2], "empty": h5py.Empty("f")}
        )
    opened = Hdf5File(tmp_path / "a.h5")
    found = {name: opened.attribute("/", name) for name in ("text", "bytes", "number", "list", "empty", "missing")}
    assert found == {"text": "π", "bytes": "abc", "number": 8, "list": None, "empty": None, "missing": None}


def test_links_inside_the_file_are_followed(tmp_path: Path) -> None:
    file = written(tmp_path / "a.h5")
    with h5py.File(file, "a") as opened:
        opened["absolute"] = h5py.SoftLink("/a")
        opened["a/relative"] = h5py.SoftLink("values")
        opened["loop"] = opened["/"]
    for place in ("absolute/values", "a/relative", "absolute/relative", "loop/loop/loop/a/values"):
        np.testing.assert_array_equal(all_frames(file, place), VALUES)


def test_what_leads_out_of_the_file_is_refused(tmp_path: Path) -> None:
    written(tmp_path / "secret.h5")
    VALUES.tofile(tmp_path / "secret.raw")
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["file"] = h5py.ExternalLink("secret.h5", "/")
        file["group"] = h5py.ExternalLink("secret.h5", "/a")
        file["values"] = h5py.ExternalLink("secret.h5", "/a/values")
        file["by_soft_link"] = h5py.SoftLink("/group/values")
        file["circle"] = h5py.SoftLink("/circle")
        layout = h5py.VirtualLayout(VALUES.shape, VALUES.dtype)
        layout[:] = h5py.VirtualSource("secret.h5", "a/values", VALUES.shape)
        file.create_virtual_dataset("virtual", layout)
        file.create_dataset("raw", VALUES.shape, VALUES.dtype, external=[("secret.raw", 0, VALUES.nbytes)])
    opened = Hdf5File(tmp_path / "a.h5")
    for place in ("file/a/values", "group/values", "values", "by_soft_link"):
        with pytest.raises(BadData, match=f"{place}: expected an object inside this file, got a link to another file"):
            opened.frames(place, SHAPE)
    for place, got in {
        "circle": "links in a circle",
        "virtual": "a virtual data set",
        "raw": "external storage",
    }.items():
        with pytest.raises(BadData, match=f"a.h5: {place}: expected .*, got {got}"):
            opened.frames(place, SHAPE)
    with pytest.raises(BadData, match="another file"):
        opened.has("file/a")


def test_sizes_are_bounded_before_anything_is_read(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("frames", (2**40, 2, 2), "u1", chunks=(1, 2, 2))
        file.create_dataset("frame", (2, 2**20, 2**20), "u1", chunks=(1, 8, 8))
        file.create_dataset("chunk", (2**12, 2**9, 2**9), "u1", chunks=(2**11, 2**9, 2**9))
        file.create_dataset("whole", (2**11, 2**9, 2**9), "u1", chunks=(1, 2**9, 2**9))
    opened = Hdf5File(tmp_path / "a.h5")
    with pytest.raises(BadData, match="frames: expected at most 2000000 rows, got 1099511627776"):
        opened.frames("frames", SHAPE, "u")
    for place, size in {"frame": 2**20, "chunk": 512}.items():
        with pytest.raises(BadData, match=f"{place}: expected at most 256 MiB at once, got {size} MiB declared"):
            opened.frames(place, SHAPE, "u")
    with pytest.raises(BadData, match="whole: expected at most 256 MiB at once, got 512 MiB"):
        opened.array("whole", SHAPE, "u")
    assert len(opened.frames("whole", SHAPE, "u")) == 2**11


def test_a_chunk_that_unpacks_to_more_than_it_declares_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(hdf5_storage, "MAX_STORED_BYTES", 500)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        bomb = file.create_dataset("bomb", (4, 32, 32), "u1", chunks=(2, 32, 32), compression="gzip")
        noise = np.random.default_rng(0).integers(0, 256, (2, 32, 32), dtype=np.uint8)
        bomb[:2] = noise
        bomb.id.write_direct_chunk((2, 0, 0), zlib.compress(bytes(10**6)))
    frames = Hdf5File(tmp_path / "a.h5").frames("bomb", SHAPE, "u")
    np.testing.assert_array_equal(frames(1), noise[1])
    with pytest.raises(BadData, match=r"bomb at \(2, 0, 0\): expected 2048 bytes, the chunk's size, got more"):
        frames(3)


def test_other_types_and_shapes_than_expected_are_refused(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["text"] = ["a", "b"]
        file.create_dataset("vlen", (3,), h5py.vlen_dtype(np.float32))
        file.create_dataset("reference", (3,), h5py.ref_dtype)
        file.create_dataset("compound", (3,), np.dtype([("x", "f4")]))
        file["empty"] = h5py.Empty("f4")
        file["type"] = np.dtype("f4")
        file["poses"] = np.zeros((3, 4, 4), np.int32)
    opened = Hdf5File(tmp_path / "a.h5")
    for place in ("text", "vlen", "reference"):
        with pytest.raises(BadData, match=f"{place}: expected floating-point numbers, got objects"):
            opened.array(place, (None,))
    for place in ("compound", "poses"):
        with pytest.raises(BadData, match=f"{place}: expected floating-point numbers, got "):
            opened.array(place, (None,))
    with pytest.raises(BadData, match=r"poses: expected shape \(any, 3, 4\), got \(3, 4, 4\)"):
        opened.array("poses", (None, 3, 4), "fi")
    for place, message in {
        "empty": "expected shape",
        "type": "expected a data set",
        "/": "expected a data set",
    }.items():
        with pytest.raises(BadData, match=message):
            opened.array(place, (None,))


def test_a_filter_that_is_not_installed_is_named(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        # 32100 is registered to nobody; HDF5 lets an optional filter be missing when writing.
        made = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        made.set_chunk((1, 2))
        made.set_filter(32100, h5py.h5z.FLAG_OPTIONAL, (1,))
        space = h5py.h5s.create_simple((3, 2))
        h5py.h5d.create(file.id, b"values", h5py.h5t.NATIVE_FLOAT, space, made)
    with pytest.raises(BadData, match="values: expected an HDF5 filter that is installed, got filter 32100"):
        Hdf5File(tmp_path / "a.h5").array("values", (None, None))


def test_a_folder_stands_for_its_only_hdf5_file(tmp_path: Path) -> None:
    with pytest.raises(
        UsageError, match="SOURCE: expected a file .hdf5 or .h5, or a folder with one, got a folder with"
    ):
        hdf5_source(tmp_path, False)
    file = written(tmp_path / "a.h5")
    (tmp_path / "._a.h5").write_bytes(b"x")
    assert hdf5_source(tmp_path, False) == hdf5_source(file, False) == file
    written(tmp_path / "b.hdf5")
    with pytest.raises(UsageError, match=r"got a\.h5, b\.hdf5\.  fix: pass the file"):
        hdf5_source(tmp_path, False)


def test_damaged_files_are_refused_with_their_name(tmp_path: Path) -> None:
    file = written(tmp_path / "a.h5", chunks=(1, 6, 4), compression="gzip", fletcher32=True)
    data = file.read_bytes()
    pointer = tmp_path / "pointer.h5"
    pointer.write_text("version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 12345\n")
    with pytest.raises(BadData, match="expected an HDF5 file, got 67 bytes of another") as refused:
        Hdf5File(pointer)
    assert "git lfs pull" in refused.value.fix
    cut = tmp_path / "cut.h5"
    cut.write_bytes(data[:-200])
    with pytest.raises(BadData, match=r"cut\.h5: .*copy it again"):
        all_frames(cut)
    with h5py.File(file) as opened:
        at = opened["a/values"].id.get_chunk_info(3).byte_offset
    flipped = tmp_path / "flipped.h5"
    flipped.write_bytes(data[:at] + bytes(b ^ 0xFF for b in data[at : at + 16]) + data[at + 16 :])
    frames = Hdf5File(flipped).frames("a/values", SHAPE)
    np.testing.assert_array_equal(frames(2), VALUES[2])
    with pytest.raises(BadData, match=r"flipped\.h5: a/values: expected readable HDF5"):
        frames(3)


def test_colour_of_16_bits_is_refused_and_not_cut(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["rgb"] = np.full((2, 4, 5, 3), 256, np.uint16)
    with pytest.raises(BadData, match="rgb: expected 8 bits per channel, got uint16"):
        Hdf5File(tmp_path / "a.h5").color("rgb")
