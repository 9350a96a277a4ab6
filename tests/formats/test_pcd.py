from __future__ import annotations

from pathlib import Path

import numpy as np
import open3d as o3d
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bask_data.errors import BadData
from bask_data.formats.pcd import Cloud, read_pcd
from tests.formats.clouds import organised, pcd
from tests.formats.folders import HEIGHT, WIDTH, K, images


def content() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    color, depth = images(1)
    metres = depth[0].astype(np.float32) / 1000
    return organised(metres, color[0], K), metres, color[0]


def held(file: Path, data: bytes) -> Cloud:
    file.write_bytes(data)
    return read_pcd(file)


@pytest.mark.parametrize("how", ["binary", "binary_compressed", "ascii"])
def test_points_and_colours_come_back_in_every_encoding(tmp_path: Path, how: str) -> None:
    points, _, color = content()
    cloud = held(tmp_path / "a.pcd", pcd(points, HEIGHT, WIDTH, how))
    assert (cloud.height, cloud.width) == (HEIGHT, WIDTH)
    for axis in "xyz":
        np.testing.assert_array_equal(cloud.columns[axis], points[axis])
    assert cloud.columns["_"].shape == (HEIGHT * WIDTH, 4)
    assert cloud.color is not None and np.array_equal(cloud.color, color)


def test_dark_colours_in_text_are_packed_bytes_however_they_are_written(tmp_path: Path) -> None:
    _, _, color = content()
    dark = organised(np.ones((HEIGHT, WIDTH), np.float32), color // 8, K)
    as_whole = held(tmp_path / "a.pcd", pcd(dark, HEIGHT, WIDTH, "ascii"))
    text = pcd(dark, HEIGHT, WIDTH, "ascii").decode()
    header, _, body = text.partition("ascii\n")
    rows = [line.rsplit(" ", 1) for line in body.splitlines()]
    floats = "\n".join(f"{row} {np.uint32(rgb).view(np.float32):.9g}" for row, rgb in rows)
    as_float = held(tmp_path / "b.pcd", f"{header}ascii\n{floats}".encode())
    for cloud in (as_whole, as_float):
        assert cloud.color is not None and np.array_equal(cloud.color, color // 8)


@pytest.mark.parametrize(("ascii", "compressed"), [(True, False), (False, False), (False, True)])
def test_clouds_that_open3d_writes_are_read(tmp_path: Path, ascii: bool, compressed: bool) -> None:
    rng = np.random.default_rng(0)
    points = np.repeat(rng.normal(size=(40, 3)).astype(np.float32), 3, axis=0)
    colors = rng.integers(0, 256, (120, 3), dtype=np.uint8)
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    cloud.colors = o3d.utility.Vector3dVector(colors / 255)
    file = tmp_path / "a.pcd"
    assert o3d.io.write_point_cloud(str(file), cloud, write_ascii=ascii, compressed=compressed)
    read = read_pcd(file)
    assert (read.height, read.width) == (1, 120)
    assert np.allclose(np.stack([read.columns[axis] for axis in "xyz"], axis=1), points, atol=1e-6)
    assert read.color is not None and np.array_equal(read.color[0], colors)


BROKEN = {
    "no header that ends with DATA": {"VERSION": "x" * 20_000},
    "-3 x 12 points": {"WIDTH": "-3"},
    "100000 x 100000 points": {"WIDTH": "100000", "HEIGHT": "100000"},
    "DATA folded": {"DATA": "folded"},
    "fields of \\[1, 1, 1, 4000, 1\\]": {"COUNT": "1 1 1 4000 1"},
    "bytes of points": {"HEIGHT": "13"},
    "invalid literal": {"WIDTH": "many"},
}


@pytest.mark.parametrize("message", BROKEN)
def test_a_file_that_is_not_what_its_header_says_is_refused(tmp_path: Path, message: str) -> None:
    points, _, _ = content()
    with pytest.raises(BadData, match=f"a.pcd: cloud: expected a PCD file with its points, got .*{message}"):
        held(tmp_path / "a.pcd", pcd(points, HEIGHT, WIDTH, **BROKEN[message]))


def test_too_long_a_text_is_refused_before_it_is_split(tmp_path: Path) -> None:
    points, _, _ = content()
    data = pcd(points, HEIGHT, WIDTH, "ascii")
    with pytest.raises(BadData, match="bytes of text: save so large a cloud as binary"):
        held(tmp_path / "a.pcd", data + b" " * (64 * 2**20))


def test_compressed_points_that_are_broken_are_refused(tmp_path: Path) -> None:
    points, _, _ = content()
    whole = pcd(points, HEIGHT, WIDTH, "binary_compressed")
    begin = whole.index(b"binary_compressed\n") + len(b"binary_compressed\n") + 8
    # A copy from before the beginning.
    with pytest.raises(BadData, match="compressed points that are broken after 0 bytes"):
        held(tmp_path / "a.pcd", whole[:begin] + b"\x20\x09" + whole[begin + 2 :])
    with pytest.raises(BadData, match="bytes of points, from"):
        held(tmp_path / "a.pcd", whole[:-1])


@given(st.binary(max_size=40), st.integers(0, 400), st.sampled_from(["binary", "binary_compressed", "ascii"]))
def test_arbitrary_bytes_give_a_cloud_or_an_error(tmp_path_factory, junk: bytes, at: int, how: str) -> None:
    points, _, _ = content()
    data = bytearray(pcd(points, HEIGHT, WIDTH, how))
    data[at : at + len(junk)] = junk
    file = tmp_path_factory.mktemp("junk") / "a.pcd"
    message = "a.pcd"
    try:
        assert held(file, bytes(data)).height > 0
    except BadData as error:
        message = str(error)
    assert "a.pcd" in message
