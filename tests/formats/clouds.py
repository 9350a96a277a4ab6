"""Organised clouds as a depth camera's driver writes them, and PCD files in all three encodings."""

from __future__ import annotations

import numpy as np

from bask_data.core.geometry import pixel_grid, unproject

RECORD = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("_", "u1", (4,)), ("rgb", "<f4")])


def organised(depth: np.ndarray, color: np.ndarray, K: np.ndarray) -> np.ndarray:
    """Points row by row, from depth (h, w) in metres and colour (h, w, 3); NaN without depth."""
    height, width = depth.shape
    points = np.zeros(depth.size, RECORD)
    xyz = unproject(pixel_grid(height, width), np.where(depth > 0, depth, np.nan), K).reshape(-1, 3)
    for i, axis in enumerate("xyz"):
        points[axis] = xyz[:, i]
    bgra = np.concatenate([color[..., ::-1], np.zeros((height, width, 1), np.uint8)], axis=2)
    points["rgb"] = np.ascontiguousarray(bgra).view("<f4").ravel()
    return points


def pcd(points: np.ndarray, height: int, width: int, how: str = "binary", **changed: str) -> bytes:
    """A PCD file; `changed` replaces lines of its header."""
    lines = {
        "VERSION": "0.7",
        "FIELDS": "x y z _ rgb",
        "SIZE": "4 4 4 1 4",
        "TYPE": "F F F U F",
        "COUNT": "1 1 1 4 1",
        "WIDTH": f"{width}",
        "HEIGHT": f"{height}",
        "VIEWPOINT": "0 0 0 1 0 0 0",
        "POINTS": f"{len(points)}",
        "DATA": how,
        **changed,
    }
    header = "".join(f"{name} {value}\n" for name, value in lines.items()).encode()
    plain = b"".join(np.ascontiguousarray(points[name]).tobytes() for name in points.dtype.names or ())
    if how == "binary":
        return header + points.tobytes()
    if how == "binary_compressed":
        packed = literal(plain)
        return header + np.array([len(packed), len(plain)], "<u4").tobytes() + packed
    packed_rgb = points["rgb"].view("<u4")
    rows = [
        f"{x:.9g} {y:.9g} {z:.9g} 0 0 0 0 {rgb}"
        for x, y, z, rgb in zip(points["x"], points["y"], points["z"], packed_rgb, strict=True)
    ]
    return header + "\n".join(rows).encode()


def literal(data: bytes) -> bytes:
    """LZF without any copy: runs of at most 32 bytes."""
    runs = [data[i : i + 32] for i in range(0, len(data), 32)]
    return b"".join(bytes([len(run) - 1]) + run for run in runs)
