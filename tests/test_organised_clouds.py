from __future__ import annotations

import numpy as np
import pytest

from tests.formats.clouds import literal
from tests.organised_clouds import CAMERA, SIZE, read_pcd, surface_of

RECORD = np.dtype([("label", "<u4"), ("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("rgba", "<u4")])


def records(height=3, width=4):
    """A slope seen by a camera: all coordinates and labels differ; the last point is missing."""
    points = np.zeros(height * width, RECORD)
    v, u = np.unravel_index(np.arange(len(points)), (height, width))
    points["z"] = 1 + 0.01 * u
    points["x"], points["y"] = 0.002 * u, 0.002 * v
    points["label"] = 10 * (1 + np.arange(len(points)))
    for axis in "xyz":
        points[axis][-1] = np.nan
    return points


def header(points, height, width, how):
    fields = " ".join(points.dtype.names)
    return (
        f"# a comment\nVERSION 0.7\nFIELDS {fields}\nSIZE 4 4 4 4 4\nTYPE U F F F U\nCOUNT 1 1 1 1 1\n"
        f"WIDTH {width}\nHEIGHT {height}\nPOINTS {len(points)}\nDATA {how}\n"
    ).encode()


def compressed(points, height, width, packed=None, size=None):
    plain = b"".join(np.ascontiguousarray(points[name]).tobytes() for name in points.dtype.names)
    packed = literal(plain) if packed is None else packed
    sizes = np.array([len(packed), len(plain) if size is None else size], "<u4").tobytes()
    return header(points, height, width, "binary_compressed") + sizes + packed


def held(file, content):
    file.write_bytes(content)
    return read_pcd(file)


@pytest.mark.parametrize("how", ["binary", "binary_compressed"])
def test_points_and_labels_come_back_as_images(tmp_path, how):
    points = records()
    content = header(points, 3, 4, how) + points.tobytes() if how == "binary" else compressed(points, 3, 4)
    cloud = held(tmp_path / "a.pcd", content)
    assert cloud.points.shape == (3, 4, 3)
    for i, axis in enumerate("xyz"):
        np.testing.assert_array_equal(cloud.points[..., i].ravel(), points[axis])
    np.testing.assert_array_equal(cloud.label.ravel(), points["label"])


def test_short_long_and_overlapping_copies_are_expanded(tmp_path):
    points = np.zeros(300, RECORD)
    points["label"] = 7
    points["rgba"] = np.arange(300)
    # The label: one literal word, then copies of it from 4 bytes back: 1196 bytes in copies of at most 264, the last
    # of them short. The three coordinates are zero: one literal byte and copies from 1 byte back.
    label = bytes([3, 7, 0, 0, 0]) + bytes([0xE0, 255, 3]) * 4 + bytes([0xE0, 131, 3])
    zeros = bytes([0, 0]) + bytes([0xE0, 255, 0]) * 13 + bytes([0xE0, 153, 0]) + bytes([0x20, 0]) + bytes([1, 0, 0])
    assert 4 + 4 * 264 + 140 == 1200
    assert 1 + 13 * 264 + 162 + 3 + 2 == 3600
    # 4 bytes of the colours are a copy from far back: the numbers 7, 0, 0, 0 are 4800 + 28 bytes after the label's.
    colours = points["rgba"].astype("<u4").tobytes()
    far = 4800 + 28 - 1
    copy = bytes([(2 << 5) | (far >> 8), far & 255])
    packed = label + zeros + literal(colours[:28]) + copy + literal(colours[32:])
    cloud = held(tmp_path / "a.pcd", compressed(points, 15, 20, packed))
    np.testing.assert_array_equal(cloud.label, np.full((15, 20), 7))
    assert not cloud.points.any()


def test_a_list_of_points_becomes_the_image_it_was(tmp_path):
    fx, fy, cx, cy = CAMERA
    points = np.zeros(3, RECORD)
    points["label"], points["z"] = [20, 30, 40], [0.5, 1.0, 2.0]
    v, u = np.array([0, 100, 479]), np.array([639, 5, 0])
    points["x"], points["y"] = (u - cx) / fx * points["z"], (v - cy) / fy * points["z"]
    cloud = held(tmp_path / "a.pcd", compressed(points, 1, 3))
    assert cloud.label.shape == SIZE
    np.testing.assert_array_equal(cloud.label[v, u], [20, 30, 40])
    np.testing.assert_array_equal(cloud.points[v, u, 2], points["z"])
    assert np.isfinite(cloud.points).all(axis=2).sum() == 3


def test_the_surface_ends_at_missing_points_and_at_steps_and_faces_the_camera():
    v, u = np.mgrid[:6, :8]
    points = np.stack([0.002 * u, 0.002 * v, np.where(u < 4, 1.0, 1.1)], axis=-1)
    points[0, 0] = np.nan
    vertices, triangles = surface_of(points)
    assert len(vertices) == 47
    # Two triangles in each of the 3 x 5 squares of both halves, less the one that the missing corner is part of.
    assert len(triangles) == 2 * 2 * 15 - 1
    corners = vertices[triangles]
    assert np.ptp(corners[..., 2], axis=1).max() == 0
    assert (np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2] < 0).all()
