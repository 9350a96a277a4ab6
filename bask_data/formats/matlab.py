"""Numeric arrays of MATLAB's version 5 files, found by name without unpacking what else a file holds.

Source: MathWorks, MAT-File Format, R2023a, chapter 1.
"""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import scipy.io
from numpy import ndarray

from bask_data.errors import BadData
from bask_data.formats.files import read_bytes

MAX_FILE_BYTES = 256 * 2**20
"""Largest file that is read, bytes: fifty times those of YCB-Video. Keeps wrong files from filling memory."""

MAX_ARRAY_BYTES = 2**20
"""Largest array that is unpacked, bytes: calibrations and poses are small, and a few bytes may stand for gigabytes."""

HEADER_BYTES = 128
"""Length of a file's header, which ends in the version and in the order of bytes."""

NAME_BYTES = 512
"""Beginning of an array that is unpacked to know its name: flags, up to 32 dimensions, and a name of 63 characters."""

MATRIX, COMPRESSED, NUMERIC = 14, 15, range(6, 16)
"""Types of elements, and classes of arrays: double, single, and whole numbers of 8 to 64 bits."""


def read_arrays(path: Path, names: Sequence[str]) -> dict[str, ndarray]:
    """The arrays of these names that a file has.

    Raises:
        BadData: no file of MATLAB's version 5 to 7, a damaged file, or an array that is not numeric or too large.
    """
    data = read_bytes(path, MAX_FILE_BYTES)
    order = {b"IM": "<", b"MI": ">"}.get(data[126:128])
    if data[:19] == b"MATLAB 7.3 MAT-file" or data[:4] == b"\x89HDF":
        fix = "save it by MATLAB's `save -v7`."
        raise BadData(path, "version", expected="a .mat file of version 5 to 7", got="7.3, which is HDF5", fix=fix)
    if order is None:
        raise BadData(path, "content", expected="a .mat file of version 5 to 7", got="another file")
    kept = [element for element in _elements(path, data, order) if _name(path, element, order, names)]
    try:
        found = scipy.io.loadmat(io.BytesIO(data[:HEADER_BYTES] + b"".join(kept)), variable_names=names)
    # SciPy's readers raise whatever the wrong bytes lead to.
    except Exception as error:
        raise _damaged(path, repr(error)) from error
    return {name: found[name] for name in names if isinstance(found.get(name), np.ndarray)}


def _elements(path: Path, data: bytes, order: str) -> Iterator[bytes]:
    """The arrays of a file, unpacked as far as their names, or whole if they are small enough."""
    position = HEADER_BYTES
    while position + 8 <= len(data):
        kind, n_bytes = struct.unpack_from(f"{order}2I", data, position)
        body = data[position + 8 : position + 8 + n_bytes]
        if len(body) < n_bytes:
            raise _damaged(path, "a truncated file")
        if kind == COMPRESSED:
            unpacker = zlib.decompressobj()
            try:
                element = unpacker.decompress(body, NAME_BYTES)
                if len(element) == NAME_BYTES and struct.unpack_from(f"{order}I", element, 4)[0] <= MAX_ARRAY_BYTES:
                    element += unpacker.decompress(unpacker.unconsumed_tail, MAX_ARRAY_BYTES)
            except zlib.error as error:
                raise _damaged(path, str(error)) from error
            yield element
        else:
            yield data[position : position + 8 + n_bytes]
        position += 8 + n_bytes


def _name(path: Path, element: bytes, order: str, names: Sequence[str]) -> str:
    """The array's name if it is one of these, otherwise nothing; `BadData` if it is, but is not a small numeric one."""
    try:
        kind, n_bytes = struct.unpack_from(f"{order}2I", element)
        if kind != MATRIX:
            return ""
        (flags,) = struct.unpack_from(f"{order}I", element, 16)
        (n_dimension_bytes,) = struct.unpack_from(f"{order}I", element, 28)
        at = 32 + (n_dimension_bytes + 7) // 8 * 8
        (tag,) = struct.unpack_from(f"{order}I", element, at)
        # Names of up to four characters stand in the tag itself, whose upper half is then their length.
        length = tag >> 16 or struct.unpack_from(f"{order}I", element, at + 4)[0]
        begin = at + (4 if tag >> 16 else 8)
    except struct.error as error:
        raise _damaged(path, str(error)) from error
    name = element[begin : begin + length].decode("ascii", "replace") if length <= NAME_BYTES else ""
    if name not in names:
        return ""
    if flags & 0xFF not in NUMERIC:
        raise BadData(path, name, expected="an array of numbers", got=f"an array of class {flags & 0xFF}")
    if n_bytes > MAX_ARRAY_BYTES:
        raise BadData(path, name, expected=f"at most {MAX_ARRAY_BYTES} bytes", got=str(n_bytes))
    return name


def _damaged(path: Path, got: str) -> BadData:
    return BadData(path, "content", expected="a readable .mat file", got=got, fix="copy it again from its source.")
