"""PCD files of the Point Cloud Library: header and points, bounded before they are unpacked."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from numpy import ndarray

from bask_data.core.compiled import compiled
from bask_data.errors import BadData
from bask_data.formats.files import MAX_IMAGE_BYTES, MAX_TEXT_BYTES, read_bytes
from bask_data.formats.images import MAX_PIXELS

DTYPES = {
    ("F", 4): "<f4",
    ("F", 8): "<f8",
    **{("U", n): f"<u{n}" for n in (1, 2, 4, 8)},
    **{("I", n): f"<i{n}" for n in (1, 2, 4, 8)},
}
"""NumPy's types by TYPE and SIZE of a field."""

COLORS = ("rgb", "rgba")
"""Names of a field of packed colours."""

MAX_HEADER_BYTES = 10_000
"""Longest header that is looked through, bytes; real ones have some hundred."""

MAX_POINT_BYTES = 1000
"""Bytes of a point that are accepted: PCL's own have up to 1.3 kB with histograms, which no camera writes."""


@dataclass(frozen=True)
class Cloud:
    """The numbers of each field by name, (h * w,) or (h * w, count); points row by row."""

    height: int
    width: int
    columns: Mapping[str, ndarray]

    @property
    def color(self) -> UInt8[ndarray, "h w 3"] | None:
        """RGB, if the points have it: packed in a field `rgb` or `rgba`, as 0xAARRGGBB."""
        packed = next((self.columns[name] for name in COLORS if name in self.columns), None)
        if packed is None or packed.dtype.itemsize != 4:
            return None
        bgra = np.ascontiguousarray(packed).view(np.uint8).reshape(self.height, self.width, 4)
        return np.ascontiguousarray(bgra[..., 2::-1])


def read_pcd(path: Path) -> Cloud:
    """The points of a PCD file: ascii, binary or binary_compressed.

    Raises:
        BadData: it is no PCD file, is cut short or corrupted, or states more than `MAX_PIXELS` points.
    """
    data = read_bytes(path, MAX_IMAGE_BYTES)
    try:
        return _parsed(data)
    except (ValueError, KeyError, IndexError) as error:
        raise BadData(
            path,
            "cloud",
            expected="a PCD file with its points",
            got=str(error)[:200],
            fix="copy it again from its source, or save it with pcl_convert_pcd_ascii_binary.",
        ) from error


def _parsed(data: bytes) -> Cloud:
    header, begin = _header(data)
    width, height = int(header["WIDTH"][0]), int(header.get("HEIGHT", ["1"])[0])
    names = header["FIELDS"]
    counts = [int(count) for count in header.get("COUNT", ["1"] * len(names))]
    kinds = zip(header["TYPE"], map(int, header["SIZE"]), strict=True)
    dtypes = [np.dtype(DTYPES[kind]) for kind in kinds]
    if not 0 < width * height <= MAX_PIXELS or width < 0:
        raise ValueError(f"{width} x {height} points")
    if min(counts) < 1 or sum(n * kind.itemsize for n, kind in zip(counts, dtypes, strict=True)) > MAX_POINT_BYTES:
        raise ValueError(f"fields of {counts} numbers")
    if "DATA" not in header:
        raise ValueError("no DATA")
    # Names may repeat: PCL calls all padding `_`.
    fields = [(f"{i} {name}", kind, (n,)) for i, (name, kind, n) in enumerate(zip(names, dtypes, counts, strict=True))]
    read = {"ascii": _of_text, "binary": _of_bytes, "binary_compressed": _of_packed_bytes}
    if header["DATA"][0] not in read:
        raise ValueError(f"DATA {header['DATA'][0]}")
    columns = read[header["DATA"][0]](data[begin:], np.dtype(fields), width * height)
    return Cloud(
        height,
        width,
        {name: column[:, 0] if n == 1 else column for name, n, column in zip(names, counts, columns, strict=True)},
    )


def _header(data: bytes) -> tuple[dict[str, list[str]], int]:
    """Words by the first word of each line, and where the points begin."""
    header: dict[str, list[str]] = {}
    position = 0
    while "DATA" not in header:
        end = data.find(b"\n", position, MAX_HEADER_BYTES)
        if end < 0:
            raise ValueError("no header that ends with DATA")
        words = data[position:end].decode("ascii", "replace").split()
        position = end + 1
        if len(words) > 1 and not words[0].startswith("#"):
            header[words[0]] = words[1:]
    return header, position


def _of_bytes(data: bytes, record: np.dtype, n_points: int) -> list[ndarray]:
    if len(data) < n_points * record.itemsize:
        raise ValueError(f"{len(data)} of {n_points * record.itemsize} bytes of points")
    points = np.frombuffer(data, record, n_points)
    return [points[name] for name in record.names or ()]


def _of_packed_bytes(data: bytes, record: np.dtype, n_points: int) -> list[ndarray]:
    """Field after field, compressed by LZF."""
    size = n_points * record.itemsize
    packed, unpacked = (int(n) for n in np.frombuffer(data, "<u4", 2))
    if unpacked != size or len(data) < 8 + packed:
        raise ValueError(f"{unpacked} of {size} bytes of points, from {len(data) - 8} of {packed}")
    plain, n_written = _unpacked(np.frombuffer(data, np.uint8, packed, 8), size)
    if n_written != size:
        raise ValueError(f"compressed points that are broken after {n_written} bytes")
    columns, begin = [], 0
    for name in record.names or ():
        kind, shape = record[name].subdtype or (record[name], (1,))
        end = begin + n_points * kind.itemsize * shape[0]
        columns.append(plain[begin:end].view(kind).reshape(n_points, *shape))
        begin = end
    return columns


def _of_text(data: bytes, record: np.dtype, n_points: int) -> list[ndarray]:
    if len(data) > MAX_TEXT_BYTES:  # As words it takes twenty times as much memory.
        raise ValueError(f"{len(data)} bytes of text: save so large a cloud as binary")
    words = data.split()
    shapes = [(name, *(record[name].subdtype or (record[name], (1,)))) for name in record.names or ()]
    n_words = sum(shape[0] for _, _, shape in shapes)
    if len(words) < n_points * n_words:
        raise ValueError(f"{len(words)} of {n_points * n_words} numbers")
    columns, begin = [], 0
    for name, kind, (count,) in shapes:
        picked = [words[begin + j :: n_words][:n_points] for j in range(count)]
        # Packed colours are written as whole numbers, or as the floating-point numbers of the same bytes.
        if name.split()[1] in COLORS and all(word.isdigit() for word in picked[0]):
            columns.append(np.array(picked, dtype=np.uint32).T.view(kind))
        else:
            with np.errstate(invalid="ignore"):  # nan where the header says whole numbers
                columns.append(np.array(picked, dtype=np.float64).T.astype(kind))
        begin += count
    return columns


@compiled
def _unpacked(packed: ndarray, size: int) -> tuple[ndarray, np.int64]:
    """LZF: runs of literal bytes, and copies of what was written before; and how many bytes came out.

    A first byte below 32 begins a run one longer than it says. Otherwise its upper three bits and, when these are all
    set, another byte are the length of the copy less two; its lower five bits and one more byte say how far back, less
    one. Copies may overlap what they write. Source: LibLZF, lzf_d.c.
    """
    plain = np.empty(size, np.uint8)
    i, o = np.int64(0), np.int64(0)
    while i < len(packed):
        control = np.int64(packed[i])
        i += 1
        if control < 32:
            n = control + 1
            if i + n > len(packed) or o + n > size:
                return plain, o
            plain[o : o + n] = packed[i : i + n]
            i += n
            o += n
            continue
        n = control >> 5
        if n == 7:
            if i >= len(packed):
                return plain, o
            n += np.int64(packed[i])
            i += 1
        if i >= len(packed):
            return plain, o
        source = o - ((control & 31) << 8) - np.int64(packed[i]) - 1
        i += 1
        n += 2
        if source < 0 or o + n > size:
            return plain, o
        for k in range(n):
            plain[o + k] = plain[source + k]
        o += n
    return plain, o
