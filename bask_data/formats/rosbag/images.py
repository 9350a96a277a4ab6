"""Images in messages of ROS: `sensor_msgs/Image`, and `CompressedImage` as image_transport writes it.

Encodings: sensor_msgs/image_encodings.h. Compressed colour and depth: compressed_subscriber.cpp and
compressed_depth_image_transport's codec.cpp, of ros-perception/image_transport_plugins.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float32, UInt8
from numpy import ndarray

from bask_data.errors import BadData
from bask_data.formats.images import MAX_PIXELS, PNG_SIGNATURE, decode_color, decode_depth, image_header
from bask_data.formats.recording import Depth

COLOR_BYTES = {"rgb8": 3, "bgr8": 3, "8UC3": 3, "rgba8": 4, "bgra8": 4, "8UC4": 4, "mono8": 1, "8UC1": 1}
"""Bytes of a pixel by encoding. Images without names of channels, 8UC3, come from OpenCV, so they are BGR."""

YUV = {
    "yuv422": cv2.COLOR_YUV2RGB_UYVY,
    "uyvy": cv2.COLOR_YUV2RGB_UYVY,
    "yuv422_yuy2": cv2.COLOR_YUV2RGB_YUY2,
    "yuyv": cv2.COLOR_YUV2RGB_YUY2,
}
"""OpenCV's conversion by encoding, of two bytes per pixel."""

DEPTH_TYPES = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}
"""NumPy's type by encoding of depth: millimetres, and metres."""

GREY = ("mono8", "8UC1")
"""Encodings of infrared images, too: colour goes before them."""

DEPTH_HEADER_BYTES = 12
"""Bytes before the PNG in compressed depth: an integer, and two parameters of the quantisation."""


@dataclass(frozen=True)
class ImageKind:
    """What the images of a topic are.

    Args:
        encoding: as in the messages; of compressed ones, what was compressed, or empty if they do not say.
        is_compressed: whether they are `CompressedImage`.
    """

    encoding: str
    is_compressed: bool

    @property
    def is_depth(self) -> bool:
        """Whether they are depth images."""
        return self.encoding in DEPTH_TYPES

    @property
    def color_rank(self) -> int:
        """2 for colour, 1 for what may be colour in an encoding that is not read, and 0 for grey and depth."""
        if self.is_depth or self.encoding in GREY:
            return 0
        return 2 if not self.encoding or self.encoding in (*COLOR_BYTES, *YUV) else 1

    @property
    def depth_scale(self) -> float:
        """Metres per unit of depth images."""
        return 1.0 if self.encoding == "32FC1" else 0.001


def image_kind(topic: str, message: Any) -> ImageKind:
    """What an image message is of."""
    if hasattr(message, "encoding"):
        return ImageKind(message.encoding, False)
    encoding, _, rest = message.format.partition(";")
    named = encoding.strip() if rest or encoding.strip() in (*COLOR_BYTES, *DEPTH_TYPES) else ""
    if not named and ("compressedDepth" in message.format or topic.endswith("/compressedDepth")):
        named = "16UC1"
    if not named and message.data[:8].tobytes() == PNG_SIGNATURE:
        named = "16UC1" if image_header(topic, _bytes(message)).bits == 16 else ""
    return ImageKind(named, True)


def color_of(where: str, message: Any) -> UInt8[ndarray, "h w 3"]:
    """RGB of an image message; grey is repeated.

    Raises:
        BadData: the encoding is another, or the message is not as it says.
    """
    if not hasattr(message, "encoding"):
        rgb = decode_color(where, _bytes(message))
        # "bgr8; jpeg compressed rgb8": compressed as if red were blue.
        return np.ascontiguousarray(rgb[..., ::-1]) if "compressed rgb" in message.format else rgb
    encoding = message.encoding
    if encoding in YUV:
        pixels = _pixels(where, message, np.dtype("u1"), 2)
        return cv2.cvtColor(np.ascontiguousarray(pixels), YUV[encoding])
    if encoding not in COLOR_BYTES:
        raise _unknown(where, encoding)
    pixels = _pixels(where, message, np.dtype("u1"), COLOR_BYTES[encoding])
    if encoding in GREY:
        return np.repeat(pixels, 3, axis=2)
    return np.ascontiguousarray(pixels[..., :3] if encoding.startswith("rgb") else pixels[..., 2::-1])


def depth_of(where: str, message: Any) -> Depth:
    """Raw depth of an image message: millimetres in 16 bits, or metres in floating point.

    Raises:
        BadData: the encoding is another, or the message is not as it says.
    """
    if not hasattr(message, "encoding"):
        return _compressed_depth(where, message)
    if message.encoding not in DEPTH_TYPES:
        raise _unknown(where, message.encoding)
    order = ">" if message.is_bigendian else "<"
    stored = np.dtype(order + DEPTH_TYPES[message.encoding])
    pixels = _pixels(where, message, stored, 1)[..., 0]
    return np.ascontiguousarray(pixels, dtype=stored.newbyteorder("="))


def _pixels(where: str, message: Any, stored: np.dtype[Any], n_channels: int) -> ndarray:
    """Pixels (h, w, channels) of an image message, without what rows are padded with."""
    height, width, step = message.height, message.width, message.step
    row = width * n_channels * stored.itemsize
    if not 0 < height * width <= MAX_PIXELS:
        raise BadData(where, "size", expected=f"1 to {MAX_PIXELS} pixels", got=f"{width} x {height}")
    if step < row or len(message.data) < (height - 1) * step + row:
        got = f"{len(message.data)} bytes in rows of {step}"
        expected = f"{height} rows of {row} bytes or more, for {width} x {height} in {message.encoding}"
        raise BadData(
            where, "data", expected=expected, got=got, fix="record the bag again, or leave it out by --frames."
        )
    data = np.asarray(message.data, np.uint8)
    rows = np.lib.stride_tricks.as_strided(data, (height, row), (step, 1), writeable=False)
    return (rows if step == row else np.ascontiguousarray(rows)).view(stored).reshape(height, width, n_channels)


def _compressed_depth(where: str, message: Any) -> Depth:
    data = _bytes(message)
    has_header = "compressedDepth" in message.format or not data.startswith(PNG_SIGNATURE)
    if "rvl" in message.format.lower():
        fix = "republish it as PNG, or raw: rosrun image_transport republish compressedDepth in:=TOPIC raw out:=DEPTH"
        raise BadData(where, "format", expected="compressedDepth with PNG", got=message.format, fix=fix)
    if not has_header:
        return decode_depth(where, data)
    if len(data) <= DEPTH_HEADER_BYTES:
        raise BadData(where, "data", expected="a PNG after 12 bytes", got=f"{len(data)} bytes")
    _, near, far = struct.unpack_from("<iff", data)
    raw = decode_depth(where, data[DEPTH_HEADER_BYTES:])
    return _of_inverse(raw, near, far) if message.format.strip().startswith("32FC1") else raw


def _of_inverse(raw: ndarray, a: float, b: float) -> Float32[ndarray, "h w"]:
    """Depth in metres that was quantised as its inverse: raw = a / depth + b; 0 = no measurement.

    Source: compressed_depth_image_transport, codec.cpp, decodeCompressedDepthImage.
    """
    quantised = raw.astype(np.float32) - np.float32(b)
    known = (raw > 0) & (quantised > 0)
    return np.where(known, np.float32(a) / np.where(known, quantised, np.float32(1)), np.float32(0))


def _bytes(message: Any) -> bytes:
    return bytes(np.asarray(message.data, np.uint8))


def _unknown(where: str, encoding: str) -> BadData:
    expected = f"one of {', '.join([*COLOR_BYTES, *YUV, *DEPTH_TYPES])}"
    fix = "record images in rgb8, or republish them with image_proc"
    fix += ", which debayers." if encoding.startswith("bayer") else "."
    return BadData(where, "encoding", expected=expected, got=encoding or "none", fix=fix)
