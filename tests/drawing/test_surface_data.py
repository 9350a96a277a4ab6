from __future__ import annotations

import base64

import numpy as np
import pytest

from bask_data.drawing.surface_data import ColouredMesh, box, frusta, joined, packed, plane_in_box, thinned


def plate(n: int) -> ColouredMesh:
    """A square of 1 m in n x n cells, facing up; its right half is red, and an object."""
    x, y = np.meshgrid(np.linspace(0, 1, n + 1), np.linspace(0, 1, n + 1))
    corner = np.arange((n + 1) ** 2).reshape(n + 1, n + 1)
    a, b, c, d = corner[:-1, :-1], corner[:-1, 1:], corner[1:, :-1], corner[1:, 1:]
    triangles = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([b, d, c], -1).reshape(-1, 3)])
    vertices = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1).astype(np.float32)
    colours = np.where(vertices[:, :1] > 0.5, [[200, 0, 0]], [[0, 0, 200]]).astype(np.uint8)
    return ColouredMesh(vertices, triangles, colours, colours[:, ::-1].copy())


def areas(mesh: ColouredMesh) -> np.ndarray:
    a, b, c = (mesh.vertices[mesh.triangles[:, i]].astype(np.float64) for i in range(3))
    return np.cross(b - a, c - a) / 2


def test_a_small_mesh_stays_as_it_is():
    mesh = plate(10)
    assert thinned(mesh, 200) is mesh


def test_a_thinned_plate_keeps_its_area_side_and_colours():
    small = thinned(plate(120), 2000)
    assert 500 < len(small.triangles) <= 2000
    signed = areas(small)
    assert (signed[:, 2] > 0).all(), "no triangle is turned over"
    assert signed[:, 2].sum() == pytest.approx(1, abs=0.1)
    clear = np.abs(small.vertices[:, 0] - 0.5) > 0.1
    red = small.vertices[:, 0] > 0.5
    assert (small.colours[clear & red] == [200, 0, 0]).all()
    assert (small.objects[clear & ~red] == [200, 0, 0]).all()


def test_packed_positions_come_back_within_the_last_place_of_16_bits():
    mesh = plate(8)
    shift = np.array([5.0, -3.0, 1.0], np.float32)
    moved = ColouredMesh(mesh.vertices + shift, mesh.triangles, mesh.colours, mesh.objects)
    data = packed(moved, box(np.zeros(3), np.ones(3), (1, 2, 3)), np.array([0, 0, 1.0]), np.zeros(3))
    whole = np.frombuffer(base64.b64decode(data["vertices"]), "<u2").reshape(-1, 3)
    back = np.array(data["low"]) + data["scale"] * whole / 65535
    np.testing.assert_allclose(back, moved.vertices, atol=2e-5)
    assert (np.frombuffer(base64.b64decode(data["triangles"]), "<u2").reshape(-1, 3) == mesh.triangles).all()


def test_the_lines_of_a_plane_lie_on_it_and_in_the_box():
    low, high = np.array([-1.0, -1, 0]), np.array([1.0, 1, 2])
    normal = np.array([0.2, -0.3, 1.0])
    plane = np.array([*normal, -0.8]) * 2
    points = plane_in_box(plane, low, high, (9, 9, 9)).points
    assert len(points) > 20
    np.testing.assert_allclose(points @ plane[:3] + plane[3], 0, atol=1e-9)
    assert ((points > low - 1e-9) & (points < high + 1e-9)).all()


def test_a_camera_begins_at_its_centre_and_looks_along_its_axis():
    world_from_camera = np.eye(4)
    world_from_camera[:3, :3] = [[0, 0, 1], [1, 0, 0], [0, 1, 0]]  # Forwards is +x of the world.
    world_from_camera[:3, 3] = [1, 2, 3]
    lines = frusta(world_from_camera[None], (0.5, 0.4), 0.1, np.array([[7, 8, 9]], np.uint8))
    assert lines.points.shape == (16, 3)
    assert (lines.points[0] == [1, 2, 3]).all()
    np.testing.assert_allclose(lines.points[[1, 3, 5, 7]].mean(axis=0), [1.1, 2, 3])
    assert joined(lines, lines).colours.shape == (32, 3)
