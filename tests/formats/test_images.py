from __future__ import annotations

import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bask_data.errors import BadData
from bask_data.formats import images
from tests.formats.folders import write_image

COLOR = np.random.default_rng(0).integers(0, 256, (12, 16, 3), dtype=np.uint8)
DEPTH = np.random.default_rng(1).integers(0, 65536, (12, 16), dtype=np.uint16)
LABELS = np.random.default_rng(2).integers(0, 5, (12, 16), dtype=np.uint8)
SMOOTH = np.broadcast_to(np.array([200, 40, 10], np.uint8), (12, 16, 3))


def encoded(suffix: str, image: np.ndarray) -> bytes:
    ok, data = cv2.imencode(suffix, image[..., ::-1] if image.ndim == 3 else image)
    assert ok
    return data.tobytes()


@pytest.mark.parametrize("suffix", [".png", ".ppm"])
def test_colour_is_rgb(tmp_path: Path, suffix: str) -> None:
    write_image(tmp_path / f"c{suffix}", COLOR)
    assert np.array_equal(images.read_color(tmp_path / f"c{suffix}"), COLOR)


def test_jpeg_colour_is_rgb(tmp_path: Path) -> None:
    write_image(tmp_path / "c.jpg", SMOOTH)
    assert np.abs(images.read_color(tmp_path / "c.jpg").astype(int) - SMOOTH).max() <= 3


def test_gray_colour_is_repeated_and_transparency_is_dropped(tmp_path: Path) -> None:
    write_image(tmp_path / "g.png", LABELS)
    cv2.imwrite(str(tmp_path / "a.png"), np.dstack([COLOR[..., ::-1], LABELS]))
    assert np.array_equal(images.read_color(tmp_path / "g.png"), np.repeat(LABELS[..., None], 3, axis=2))
    assert np.array_equal(images.read_color(tmp_path / "a.png"), COLOR)


def test_exif_rotation_is_ignored_as_intrinsics_do_not_follow_it(tmp_path: Path) -> None:
    data = encoded(".jpg", SMOOTH)
    orientation = b"Exif\0\0II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0\x06\0\0\0\0\0\0\0"
    (tmp_path / "c.jpg").write_bytes(
        data[:2] + b"\xff\xe1" + (len(orientation) + 2).to_bytes(2, "big") + orientation + data[2:]
    )
    assert cv2.imread(str(tmp_path / "c.jpg")).shape == (16, 12, 3)
    assert images.read_color(tmp_path / "c.jpg").shape == (12, 16, 3)


@pytest.mark.parametrize("suffix", [".png", ".pgm"])
def test_depth_is_read_bit_for_bit(tmp_path: Path, suffix: str) -> None:
    write_image(tmp_path / f"d{suffix}", DEPTH)
    assert np.array_equal(images.read_depth(tmp_path / f"d{suffix}"), DEPTH)


def test_labels_are_read_bit_for_bit(tmp_path: Path) -> None:
    write_image(tmp_path / "l.png", LABELS)
    assert np.array_equal(images.read_labels(tmp_path / "l.png"), LABELS)


def test_colour_of_16_bits_is_refused(tmp_path: Path) -> None:
    write_image(tmp_path / "c.png", COLOR.astype(np.uint16) * 257)
    with pytest.raises(BadData, match="colour: expected 8 bits per channel, got 16.  fix: convert"):
        images.read_color(tmp_path / "c.png")


@pytest.mark.parametrize(
    ("image", "got"), [(LABELS, "1 of 8"), (COLOR, "3 of 8"), (COLOR.astype(np.uint16), "3 of 16")]
)
def test_depth_of_8_bits_or_in_colour_is_refused(tmp_path: Path, image: np.ndarray, got: str) -> None:
    write_image(tmp_path / "d.png", image)
    with pytest.raises(
        BadData,
        match=f"depth: expected one channel of 16 bits, got {got}.  fix: check that this is the depth, or export",
    ):
        images.read_depth(tmp_path / "d.png")


def test_labels_in_colour_are_refused(tmp_path: Path) -> None:
    write_image(tmp_path / "l.png", COLOR)
    with pytest.raises(BadData, match="labels: expected one channel of 8 bits, got 3 of 8.*grey values"):
        images.read_labels(tmp_path / "l.png")


@pytest.mark.parametrize("data", [b"GIF89a......", b"\x80\x04\x95pickle", b"#!/bin/sh\n"])
def test_a_file_that_is_not_an_image_is_refused(tmp_path: Path, data: bytes) -> None:
    (tmp_path / "c.png").write_bytes(data)
    with pytest.raises(BadData, match="image: expected a PNG, JPEG, TIFF, WebP, PGM or PPM file"):
        images.read_color(tmp_path / "c.png")


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".pgm"])
@given(st.data())
def test_an_image_truncated_anywhere_is_refused(tmp_path_factory, suffix: str, data: st.DataObject) -> None:
    whole = encoded(suffix, DEPTH if suffix == ".pgm" else COLOR)
    path = tmp_path_factory.mktemp("cut") / f"c{suffix}"
    path.write_bytes(whole[: data.draw(st.integers(2, len(whole) - 1))])
    with pytest.raises(BadData, match=r"c\.(png|jpg|pgm): image: expected .* got"):
        images.image_header(path)


@given(st.integers(16, 400), st.integers(1, 255))
def test_a_changed_byte_in_a_png_is_detected(tmp_path_factory, position: int, change: int) -> None:
    data = bytearray(encoded(".png", DEPTH))
    data[position] ^= change
    path = tmp_path_factory.mktemp("flip") / "d.png"
    path.write_bytes(data)
    with pytest.raises(BadData, match="truncated or corrupted"):
        images.read_depth(path)


def test_bytes_after_the_end_of_an_image_are_ignored(tmp_path: Path) -> None:
    (tmp_path / "d.png").write_bytes(encoded(".png", DEPTH) + b"more")
    assert np.array_equal(images.read_depth(tmp_path / "d.png"), DEPTH)


def test_an_image_of_a_billion_pixels_is_refused_by_its_header(tmp_path: Path) -> None:
    def chunk(kind: bytes, body: bytes) -> bytes:
        return len(body).to_bytes(4, "big") + kind + body + zlib.crc32(kind + body).to_bytes(4, "big")

    size = (40_000).to_bytes(4, "big")
    header = chunk(b"IHDR", size + size + bytes([16, 0, 0, 0, 0]))
    (tmp_path / "d.png").write_bytes(images.PNG_SIGNATURE + header + chunk(b"IEND", b""))
    with pytest.raises(BadData, match="size: expected 1 to 100000000 pixels, got 40000 x 40000 in the header"):
        images.read_depth(tmp_path / "d.png")


def test_a_png_with_valid_checksums_and_no_picture_is_refused(tmp_path: Path) -> None:
    def chunk(kind: bytes, body: bytes) -> bytes:
        return len(body).to_bytes(4, "big") + kind + body + zlib.crc32(kind + body).to_bytes(4, "big")

    header = chunk(b"IHDR", (16).to_bytes(4, "big") + (12).to_bytes(4, "big") + bytes([16, 0, 0, 0, 0]))
    (tmp_path / "d.png").write_bytes(images.PNG_SIGNATURE + header + chunk(b"IDAT", b"junk") + chunk(b"IEND", b""))
    with pytest.raises(BadData, match="image: expected a readable image, got one that does not decode"):
        images.read_depth(tmp_path / "d.png")


def test_a_jpeg_thumbnail_does_not_hide_a_missing_end(tmp_path: Path) -> None:
    data = encoded(".jpg", COLOR)
    thumbnail = b"\xff\xe1" + (6).to_bytes(2, "big") + b"\xff\xd9\xff\xd9"
    (tmp_path / "c.jpg").write_bytes((data[:2] + thumbnail + data[2:])[:-2])
    with pytest.raises(BadData, match="expected a JPEG with a frame header and an end marker"):
        images.read_color(tmp_path / "c.jpg")


def test_an_invalid_pgm_header_is_refused(tmp_path: Path) -> None:
    (tmp_path / "d.pgm").write_bytes(b"P5\n16 twelve\n65535\n")
    with pytest.raises(BadData, match="expected a PGM or PPM header"):
        images.read_depth(tmp_path / "d.pgm")
