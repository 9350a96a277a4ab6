"""Organised point clouds: PCD files as a depth camera's single view leaves them, and the surface they show."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numba import njit

DTYPES = {("F", 4): "<f4", ("F", 8): "<f8", ("U", 1): "u1", ("U", 2): "<u2", ("U", 4): "<u4", ("I", 4): "<i4"}

SIZE = (480, 640)
CAMERA = (525.0, 525.0, 319.5, 239.5)
"""fx, fy, cx, cy in pixels of the depth cameras whose drivers wrote such files, whatever the lens: the driver made the
points with them."""


@dataclass(frozen=True)
class OrganisedCloud:
    """What a PCD file holds, as images.

    Args:
        points: (h, w, 3) float32, metres, camera frame; NaN where there is none.
        label: (h, w) uint32, 0 where there is no point; or None without labels.
    """

    points: np.ndarray
    label: np.ndarray | None


def read_pcd(file: Path) -> OrganisedCloud:
    """A depth camera's cloud in PCD 0.7, `DATA binary` or `binary_compressed`, one number per field.

    A file that lists its points instead (height 1) is made an image of `SIZE` again: `CAMERA` saw them.

    Raises:
        ValueError: the file is something else, is cut short, or its compressed data is broken.
    """
    content = file.read_bytes()
    header: dict[str, list[str]] = {}
    position = 0
    while "DATA" not in header:
        end = content.find(b"\n", position)
        if end < 0:
            raise ValueError(f"{file}: expected a PCD header that ends with DATA")
        words = content[position:end].decode("ascii", "replace").split()
        position = end + 1
        if words and not words[0].startswith("#"):
            header[words[0]] = words[1:]
    width, height = int(header["WIDTH"][0]), int(header["HEIGHT"][0])
    kinds = zip(header["TYPE"], map(int, header["SIZE"]), strict=True)
    fields = dict(zip(header["FIELDS"], (DTYPES[kind] for kind in kinds), strict=True))
    if set(header.get("COUNT", ["1"])) != {"1"}:
        raise ValueError(f"{file}: expected one number per field, got COUNT {header['COUNT']}")
    columns = _columns(content[position:], header["DATA"][0], fields, width * height, file)
    points = np.stack([columns[axis].astype(np.float32) for axis in "xyz"], axis=-1)
    label = columns.get("label")
    where: tuple[np.ndarray, ...] = np.unravel_index(np.arange(width * height), (height, width))
    if height == 1:
        (height, width), where = SIZE, _pixels(points)
    image, labels = np.full((height, width, 3), np.nan, np.float32), np.zeros((height, width), np.uint32)
    image[where] = points
    if label is not None:
        labels[where] = label
    return OrganisedCloud(image, None if label is None else labels)


def _pixels(points: np.ndarray) -> tuple[np.ndarray, ...]:
    """Row and column in an image of `SIZE` of points (n, 3) in the camera frame."""
    fx, fy, cx, cy = CAMERA
    u, v = fx * points[:, 0] / points[:, 2] + cx, fy * points[:, 1] / points[:, 2] + cy
    return tuple(np.rint(np.stack([v, u])).astype(int).clip(0, np.array(SIZE)[:, None] - 1))


def _columns(data: bytes, how: str, fields: dict[str, str], n_points: int, file: Path) -> dict[str, np.ndarray]:
    """Each field's numbers. Compressed files hold field after field, others point after point."""
    record = np.dtype(list(fields.items()))
    n_bytes = record.itemsize * n_points
    if how == "binary":
        if len(data) < n_bytes:
            raise ValueError(f"{file}: expected {n_bytes} bytes of points, got {len(data)}")
        points = np.frombuffer(data, record, n_points)
        return {name: points[name] for name in fields}
    if how != "binary_compressed":
        raise ValueError(f"{file}: expected DATA binary or binary_compressed, got {how}")
    packed, unpacked = np.frombuffer(data, "<u4", 2).tolist()
    if unpacked != n_bytes or len(data) < 8 + packed:
        raise ValueError(f"{file}: expected {n_bytes} bytes of points from {packed}, got {unpacked} from {len(data)}")
    plain, n_written = _expanded(np.frombuffer(data, np.uint8, packed, 8), unpacked)
    if n_written != unpacked:
        raise ValueError(f"{file}: the compressed points are broken after {max(n_written, 0)} bytes")
    columns, begin = {}, 0
    for name, dtype in fields.items():
        size = np.dtype(dtype).itemsize * n_points
        columns[name] = plain[begin : begin + size].view(dtype)
        begin += size
    return columns


@njit(cache=True)
def _expanded(packed: np.ndarray, size: int) -> tuple[np.ndarray, int]:
    """LZF: runs of literal bytes, and copies of what was written before; and how many bytes came out.

    A first byte below 32 begins a run one longer than it says. Otherwise its upper three bits and, when these are all
    set, another byte are the length of the copy less two; its lower five bits and one more byte say how far back, less
    one. Copies may overlap what they write.
    """
    plain = np.empty(size, np.uint8)
    i, o = 0, 0
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


def surface_of(points: np.ndarray, slack: tuple[float, float] = (0.005, 0.01)) -> tuple[np.ndarray, np.ndarray]:
    """(n, 3) float32 vertices, row by row, and (m, 3) int32 triangles between neighbouring pixels at like depths.

    Corners run counter-clockwise as the camera sees them.

    Args:
        points: (h, w, 3), NaN where there is none.
        slack: (a, b) of the a + b z metres that neighbours on one surface differ in depth.
    """
    valid = np.isfinite(points).all(axis=2)
    number = np.cumsum(valid).reshape(valid.shape) - 1
    corner = (slice(None, -1), slice(1, None))
    a, b, c, d = ((rows, columns) for rows in corner for columns in corner)
    triangles = []
    for first, second, third in ((a, c, b), (b, c, d)):
        z = np.stack([points[one][..., 2] for one in (first, second, third)], axis=-1)
        whole = valid[first] & valid[second] & valid[third]
        near = np.ptp(np.where(whole[..., None], z, 0), axis=-1) < slack[0] + slack[1] * np.where(whole, z[..., 0], 0)
        triangles.append(np.stack([number[one][whole & near] for one in (first, second, third)], axis=-1))
    return points[valid].astype(np.float32), np.concatenate(triangles).astype(np.int32)
