"""Header of a TIFF file, read before it is decoded."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np

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
        ends = [offset + n for offset, n in zip(entries[parts[0]], entries[parts[1]], strict=True)]
        if not ends or max(ends) > len(data):
            raise ValueError("pixels that end after the file")
        bits = set(entries.get(BITS, [1]))
        if len(bits) != 1:
            raise ValueError("channels of different depth")
        return TiffHeader(
            height=entries[HEIGHT][0],
            width=entries[WIDTH][0],
            bits=bits.pop(),
            channels=entries.get(CHANNELS, [1])[0],
            is_float=entries.get(FORMAT, [1])[0] == FLOAT,
        )
    except (struct.error, ValueError, KeyError, IndexError) as error:
        raise BadData(
            path,
            "image",
            expected="a TIFF with size and pixels",
            got=f"a truncated or corrupted file ({error})",
            fix="copy it again from its source, or convert it to PNG.",
        ) from error


def _entries(data: bytes) -> dict[int, list[int]]:
    """Whole numbers of the first directory, by tag."""
    order = "<" if data[:2] == b"II" else ">"
    [begin] = struct.unpack_from(f"{order}I", data, 4)
    [n_entries] = struct.unpack_from(f"{order}H", data, begin)
    if n_entries > MAX_ENTRIES:
        raise ValueError(f"{n_entries} entries")
    entries = {}
    for at in range(begin + 2, begin + 2 + 12 * n_entries, 12):
        tag, kind, count = struct.unpack_from(f"{order}HHI", data, at)
        if kind in VALUES:
            dtype = np.dtype(order + VALUES[kind])
            n_bytes = dtype.itemsize * count
            place = at + 8 if n_bytes <= 4 else struct.unpack_from(f"{order}I", data, at + 8)[0]
            entries[tag] = [int(value) for value in np.frombuffer(data, dtype, count, place)] if count else []
    return entries
