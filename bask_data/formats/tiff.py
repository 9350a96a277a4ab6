"""Header of a TIFF file, read before it is decoded."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Integer
from numpy import ndarray

from bask_data.errors import BadData

SIGNATURES = (b"II*\0", b"MM\0*")
"""First bytes of a TIFF, by the order of its bytes."""

MAX_ENTRIES = 1000
"""Entries of a directory that are looked at: files have 10 to 50."""

VALUES = {1: "B", 3: "H", 4: "I"}
"""Types of entries that hold whole numbers, as NumPy names them."""

WIDTH, HEIGHT, BITS, CHANNELS, FORMAT = 256, 257, 258, 277, 339
PARTS = ((273, 279), (324, 325))
"""Offsets and byte counts of strips, and of tiles."""

LOOKED_AT = {WIDTH, HEIGHT, BITS, CHANNELS, FORMAT, *(tag for pair in PARTS for tag in pair)}
"""Tags whose values are read: any other may claim as many values as the file has bytes."""

FLOAT = 3
"""Sample format of floating point."""


@dataclass(frozen=True)
class TiffHeader:
    """What the first image of a TIFF holds."""

    height: int
    width: int
    bits: int
    channels: int
    is_float: bool


def tiff_header(path: Path | str, data: bytes) -> TiffHeader:
    """Header of the first image; `BadData` for a truncated or corrupted file."""
    try:
        entries = _entries(data)
        parts = next((pair for pair in PARTS if pair[0] in entries), PARTS[0])
        begins, sizes = (entries[tag].astype(np.int64) for tag in parts)
        if not len(begins) or len(begins) != len(sizes) or (begins + sizes).max() > len(data):
            raise ValueError("pixels that end after the file")
        bits = np.unique(entries.get(BITS, [1]))
        if len(bits) != 1:
            raise ValueError("channels of different depth")
        return TiffHeader(
            height=int(entries[HEIGHT][0]),
            width=int(entries[WIDTH][0]),
            bits=int(bits[0]),
            channels=int(entries.get(CHANNELS, [1])[0]),
            is_float=int(entries.get(FORMAT, [1])[0]) == FLOAT,
        )
    except (struct.error, ValueError, KeyError, IndexError) as error:
        raise BadData(
            path,
            "image",
            expected="a TIFF with size and pixels",
            got=f"a truncated or corrupted file ({error})",
            fix="copy it again from its source, or convert it to PNG.",
        ) from error


def _entries(data: bytes) -> dict[int, Integer[ndarray, " n"]]:
    """Whole numbers of the first directory, by tag, as far as they are looked at."""
    order = "<" if data[:2] == b"II" else ">"
    [begin] = struct.unpack_from(f"{order}I", data, 4)
    [n_entries] = struct.unpack_from(f"{order}H", data, begin)
    if n_entries > MAX_ENTRIES:
        raise ValueError(f"{n_entries} entries")
    entries = {}
    for at in range(begin + 2, begin + 2 + 12 * n_entries, 12):
        tag, kind, count = struct.unpack_from(f"{order}HHI", data, at)
        if kind in VALUES and tag in LOOKED_AT:
            dtype = np.dtype(order + VALUES[kind])
            n_bytes = dtype.itemsize * count
            place = at + 8 if n_bytes <= 4 else struct.unpack_from(f"{order}I", data, at + 8)[0]
            entries[tag] = np.frombuffer(data, dtype, count, place) if count else np.zeros(0, dtype)
    return entries
