"""Image files, checked before they are decoded: corrupted, mislabelled and huge files are refused with their name.

OpenCV returns None for an unreadable file, decodes a truncated one as far as possible, and rotates JPEGs by their EXIF
tag, all without an error.
"""

from __future__ import annotations

import re
import zlib
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8, UInt16
from numpy import ndarray

from bask_data.errors import BadData
from bask_data.formats import tiff
from bask_data.formats.files import read_bytes

MAX_PIXELS = 100_000_000
"""Largest image that is decoded, by its header: 100 megapixels. A small file may claim any size, and decoding would
allocate memory for it."""

MAX_POINTER_BYTES = 1000
"""Longest text that stands for a file, bytes: Git LFS's and git-annex's have at most some hundred."""

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
PNG_CHANNELS = {0: 1, 2: 3, 3: 3, 4: 2, 6: 4}
"""Channels by PNG colour type; a palette (3) decodes to colour."""


@dataclass(frozen=True)
class ImageHeader:
    """Size in pixels, bits per channel and number of channels of an image file."""

    height: int
    width: int
    bits: int
    channels: int
    is_float: bool = False


def image_header(path: Path | str, data: bytes | None = None) -> ImageHeader:
    """Header of a complete PNG, JPEG, TIFF, WebP, PGM or PPM file.

    Args:
        data: content of the file; read from `path` if None.

    Raises:
        BadData: another format, a truncated file, a wrong checksum, or more than `MAX_PIXELS`.
    """
    data = read_bytes(Path(path)) if data is None else data
    if data.startswith(PNG_SIGNATURE):
        header = _png_header(path, data)
    elif data.startswith(b"\xff\xd8"):
        header = _jpeg_header(path, data)
    elif data[:2] in (b"P5", b"P6"):
        header = _pnm_header(path, data)
    elif data[:4] in tiff.SIGNATURES:
        found = tiff.tiff_header(path, data)
        header = ImageHeader(found.height, found.width, found.bits, found.channels, found.is_float)
    elif data[:4] == b"RIFF" and data[8:12] == b"WEBP":
        header = _webp_header(path, data)
    elif len(data) < MAX_POINTER_BYTES and (data[:1] in b"/." or b"git-lfs" in data or b"annex" in data):
        raise BadData(
            path,
            "image",
            expected="a picture",
            got=f"a link to one, stored as text: {data[:80].decode('utf-8', 'replace')!r}",
            fix="fetch what it stands for (`git lfs pull`, `git annex get`), or copy the recording with its links.",
        )
    else:
        raise BadData(
            path,
            "image",
            expected="a PNG, JPEG, TIFF, WebP, PGM or PPM file",
            got=f"bytes {data[:8]!r}",
            fix="convert it to PNG; depth in floating point to 16-bit units, for instance millimetres.",
        )
    if not 0 < header.height * header.width <= MAX_PIXELS:
        raise BadData(
            path, "size", expected=f"1 to {MAX_PIXELS} pixels", got=f"{header.width} x {header.height} in the header"
        )
    return header


def read_color(path: Path) -> UInt8[ndarray, "h w 3"]:
    """A colour image as RGB. Grey is repeated, transparency dropped; EXIF rotation is ignored, as it is by K."""
    return decode_color(path, read_bytes(path))


def decode_color(path: Path | str, data: bytes) -> UInt8[ndarray, "h w 3"]:
    """As `read_color`, from the content of a file, or from a part of it; `path` is for messages."""
    header = image_header(path, data)
    check_color(path, header)
    image = decode(path, data, header, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    # Forty times as fast as a reversed copy by NumPy, which would take half as long as decoding.
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def read_depth(path: Path) -> UInt16[ndarray, "h w"]:
    """A raw 16-bit depth image."""
    return decode_depth(path, read_bytes(path))


def decode_depth(path: Path | str, data: bytes) -> UInt16[ndarray, "h w"]:
    """As `read_depth`, from the content of a file; `path` is for messages."""
    header = image_header(path, data)
    check_depth(path, header)
    return decode(path, data, header, cv2.IMREAD_UNCHANGED)


def read_labels(path: Path) -> UInt8[ndarray, "h w"]:
    """An 8-bit label image."""
    return decode_labels(path, read_bytes(path))


def decode_labels(path: Path | str, data: bytes) -> UInt8[ndarray, "h w"]:
    """As `read_labels`, from the content of a file; `path` is for messages."""
    header = image_header(path, data)
    check_labels(path, header)
    return decode(path, data, header, cv2.IMREAD_UNCHANGED)


def check_color(path: Path | str, header: ImageHeader) -> None:
    """Refuse colour with more than 8 bits per channel, whose scaling is unknown; `BadData`."""
    if header.bits != 8:
        raise BadData(
            path,
            "colour",
            expected="8 bits per channel",
            got=f"{header.bits}",
            fix="convert the image to 8 bits per channel.",
        )


def check_depth(path: Path | str, header: ImageHeader) -> None:
    """Refuse anything but one channel of 16 bits; `BadData`."""
    if (header.bits, header.channels, header.is_float) != (16, 1, False):
        raise BadData(
            path,
            "depth",
            expected="one channel of 16 bits",
            got=f"{header.channels} of {header.bits}{', floating point' if header.is_float else ''}",
            fix="check that this is the depth, or export it raw: 8-bit and coloured depth images are for display only.",
        )


def check_labels(path: Path | str, header: ImageHeader) -> None:
    """Refuse anything but one channel of 8 bits, as palettes decode to colours; `BadData`."""
    if (header.bits, header.channels) != (8, 1):
        raise BadData(
            path,
            "labels",
            expected="one channel of 8 bits",
            got=f"{header.channels} of {header.bits}",
            fix="write the instances' numbers as grey values, 0 for background: colours of classes are not read.",
        )


def decode(path: Path | str, data: bytes, header: ImageHeader, flags: int) -> ndarray:
    """The image in a file's bytes, whose header was checked; `BadData` if it does not decode, or not to that size."""
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:
        image = None
    if image is None or image.shape[:2] != (header.height, header.width):
        raise BadData(
            path,
            "image",
            expected="a readable image",
            got="one that does not decode",
            fix="copy it again from its source.",
        )
    return image


def _truncated(path: Path | str, expected: str) -> BadData:
    return BadData(
        path, "image", expected=expected, got="a truncated or corrupted file", fix="copy it again from its source."
    )


def _png_header(path: Path | str, data: bytes) -> ImageHeader:
    """Header of a PNG. Checksums of all chunks take a millisecond and catch errors that decoders only warn about."""
    position, header = len(PNG_SIGNATURE), None
    while position + 12 <= len(data):
        length = int.from_bytes(data[position : position + 4], "big")
        kind = data[position + 4 : position + 8]
        end = position + 8 + length
        if zlib.crc32(data[position + 4 : end]) != int.from_bytes(data[end : end + 4], "big"):
            raise _truncated(path, "PNG chunks with their checksums")
        if kind == b"IHDR" and length == 13:
            width, height = (int.from_bytes(data[position + at : position + at + 4], "big") for at in (8, 12))
            bits, color_type = data[position + 16], data[position + 17]
            palette = color_type == 3
            header = ImageHeader(height, width, 8 if palette else bits, PNG_CHANNELS.get(color_type, 0))
        if kind == b"IEND" and header is not None:
            return header
        position = end + 4
    raise _truncated(path, "a PNG that ends in IEND")


def _jpeg_header(path: Path | str, data: bytes) -> ImageHeader:
    """Header of a JPEG. Its end marker is searched after the segments, as embedded thumbnails have one, too."""
    position, header = 2, None
    while position + 4 <= len(data) and data[position] == 0xFF:
        marker = data[position + 1]
        if marker == 0xFF:
            position += 1
            continue
        length = int.from_bytes(data[position + 2 : position + 4], "big")
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC) and position + 10 <= len(data):
            height, width = (int.from_bytes(data[position + at : position + at + 2], "big") for at in (5, 7))
            header = ImageHeader(height, width, data[position + 4], data[position + 9])
        position += 2 + length
        if marker == 0xDA:
            break
    if header is None or data.find(b"\xff\xd9", position) < 0:
        raise _truncated(path, "a JPEG with a frame header and an end marker")
    return header


def _webp_header(path: Path | str, data: bytes) -> ImageHeader:
    """Size from the first chunk: of the canvas (VP8X), of a lossless image (VP8L) or of a lossy one (VP8)."""
    if len(data) < max(30, 8 + int.from_bytes(data[4:8], "little")):
        raise _truncated(path, "a WebP of the stated length")
    kind = data[12:16]
    if kind == b"VP8X":
        width, height = (int.from_bytes(data[at : at + 3], "little") + 1 for at in (24, 27))
    elif kind == b"VP8L":
        packed = int.from_bytes(data[21:25], "little")
        width, height = (packed & 0x3FFF) + 1, (packed >> 14 & 0x3FFF) + 1
    elif kind == b"VP8 ":
        width, height = (int.from_bytes(data[at : at + 2], "little") & 0x3FFF for at in (26, 28))
    else:
        raise _truncated(path, "a WebP image")
    return ImageHeader(height, width, 8, 3)


def _pnm_header(path: Path | str, data: bytes) -> ImageHeader:
    space = rb"(?:\s|#[^\n]*\n)+"
    match = re.match(rb"P([56])" + space + rb"(\d{1,9})" + space + rb"(\d{1,9})" + space + rb"(\d{1,5})\s", data[:4096])
    if match is None:
        raise _truncated(path, "a PGM or PPM header")
    kind, width, height, largest = (int(group) for group in match.groups())
    header = ImageHeader(height, width, 8 if largest < 256 else 16, 1 if kind == 5 else 3)
    if len(data) - match.end() < height * width * header.channels * header.bits // 8:
        raise _truncated(path, f"{width} x {height} pixels")
    return header
