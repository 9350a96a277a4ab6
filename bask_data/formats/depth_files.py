"""Depth images of any kind that people save: 16-bit images, and floating point as TIFF, EXR or NumPy array."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from bask_data.errors import BadData, imported
from bask_data.formats import tiff
from bask_data.formats.arrays import NPY_SIGNATURE, read_npy
from bask_data.formats.depth_values import LARGEST
from bask_data.formats.files import MAX_IMAGE_BYTES, read_bytes, read_head
from bask_data.formats.images import MAX_PIXELS, decode, decode_depth, image_header
from bask_data.formats.recording import Depth

SCALE_OF_WHOLE_NUMBERS, SCALE_OF_FLOAT = 0.001, 1.0
"""Metres per unit of depth unless stated: most cameras give millimetres, and most scripts save metres."""

EXR_SIGNATURE = b"v/1\x01"

NOTHING_BEYOND = 1e9
"""Floating-point depth from which on nothing was measured: Blender writes 1e10 where a ray meets nothing."""

EXR_CHANNELS = ("Z", "Y", "V", "R", "depth", "Depth")
"""Names of a depth channel, of a file with several: OpenEXR's, grey images', Blender's, and those of scripts."""


def read_any_depth(path: Path) -> Depth:
    """Raw depth: 16-bit, or float32 with 0 for no measurement.

    Raises:
        BadData: another kind of file, a broken one, or one of more than one channel.
        MissingDependency: OpenEXR is needed for the file, and not installed.
    """
    head = read_head(path, len(NPY_SIGNATURE))
    if head == NPY_SIGNATURE:
        return depth_of_array(path, read_npy(path, MAX_PIXELS))
    if head.startswith(EXR_SIGNATURE):
        return _measured(_read_exr(path))
    return decode_any_depth(path, read_bytes(path))


def decode_any_depth(path: Path | str, data: bytes) -> Depth:
    """As `read_any_depth`, from the content of an image file: 16 bits, or floating point in a TIFF; `path` is for
    messages."""
    if data[:4] in tiff.SIGNATURES:
        header = image_header(path, data)
        if header.is_float:
            if header.channels != 1 or header.bits not in (32, 64):
                raise _not_one_channel(path, f"{header.channels} of {header.bits} bits")
            return _measured(decode(path, data, header, cv2.IMREAD_UNCHANGED))
    return decode_depth(path, data)


def _measured(values: ndarray) -> Float32[ndarray, "h w"]:
    """Floating-point depth without NaN, infinite and negative values, and what is beyond every sensor."""
    with np.errstate(over="ignore"):
        metres = np.array(values, dtype=np.float32)
    metres[~((metres > 0) & (metres < np.float32(NOTHING_BEYOND)))] = 0
    return metres


def depth_of_array(path: Path | str, array: ndarray) -> Depth:
    """As `read_any_depth`, from an array (h, w), of whole numbers or in floating point; `path` is for messages."""
    # (1, h, w) and (h, w, 1) are what networks and simulators hand over.
    image = array[0] if array.ndim == 3 and len(array) == 1 else array
    image = image[..., 0] if image.ndim == 3 and image.shape[2] == 1 else image
    if image.ndim != 2 or not image.size:
        raise _not_one_channel(path, f"an array {array.shape}")
    if image.dtype.kind == "f":
        return _measured(image)
    least, most = int(image.min()), int(image.max())
    if least < 0 or most > LARGEST:
        raise BadData(
            path,
            "depth",
            expected=f"whole numbers from 0 to {LARGEST}",
            got=f"{least} to {most}",
            fix="save it as floating point, or in units of which an image has fewer.",
        )
    return np.array(image).astype(np.uint16)


def _read_exr(path: Path) -> ndarray:
    """The one channel of an EXR file, or the first of three equal ones; its header bounds what is decoded."""
    OpenEXR = imported("OpenEXR", "OpenEXR", user=str(path), extra="formats")
    if path.stat().st_size > MAX_IMAGE_BYTES:
        raise BadData(path, "size", expected=f"at most {MAX_IMAGE_BYTES} bytes", got=path.stat().st_size)
    try:
        parts = OpenEXR.File(str(path), header_only=True).parts
        header = parts[0].header
        width, height = (int(last) - int(first) + 1 for first, last in zip(*header["dataWindow"], strict=True))
        n_values = width * height * len(header["channels"])
        if len(parts) != 1 or min(width, height) < 1 or n_values > MAX_PIXELS:
            got = f"{len(parts)} of {width} x {height} with {len(header['channels'])} channels"
            raise BadData(path, "size", expected=f"one image of 1 to {MAX_PIXELS} values", got=got)
        image = OpenEXR.File(str(path), separate_channels=True)
        channels = {name: channel.pixels for name, channel in image.channels().items()}
    except (RuntimeError, ValueError, TypeError, KeyError) as error:
        raise BadData(
            path,
            "image",
            expected="a readable EXR",
            got=str(error)[:200],
            fix="copy it again from its source.",
        ) from error
    names = [name for name in channels if name.rsplit(".", 1)[-1] in EXR_CHANNELS] or list(channels)
    values = channels[names[0]]
    if len(channels) > 1 and not all(np.array_equal(values, other, equal_nan=True) for other in channels.values()):
        raise _not_one_channel(path, f"channels {', '.join(sorted(channels))}")
    if values.dtype.kind != "f" or values.shape != (height, width):
        raise _not_one_channel(path, f"{values.shape} of {values.dtype}")
    return values


def _not_one_channel(path: Path | str, got: str) -> BadData:
    return BadData(
        path,
        "depth",
        expected="one channel, of 16 bits or in floating point",
        got=got,
        fix="check that this is the depth, or save depth alone: as 16-bit PNG, or with numpy.save.",
    )
