"""A surface with its cameras, small enough to be part of a page: triangles, colours and lines in a few hundred kB."""

from __future__ import annotations

import base64
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy import ndarray

MOST_TRIANGLES = 30_000
"""Triangles of a surface on a page: 16 bytes each, vertices included."""

MOST_VERTICES = 60_000
"""Vertices that 16 bits can number, with some to spare."""

LARGEST = 65535
"""Positions are whole numbers up to this along the longest edge of the box: 15 micrometres of a metre."""


@dataclass(frozen=True)
class ColouredMesh:
    """Triangles whose vertices have two colours: as recorded, and by object.

    Args:
        vertices: metres, world frame.
        objects: colours by object.
    """

    vertices: Float[ndarray, "n 3"]
    triangles: Int[ndarray, "m 3"]
    colours: UInt8[ndarray, "n 3"]
    objects: UInt8[ndarray, "n 3"]


@dataclass(frozen=True)
class Lines:
    """Line segments, two points each, with a colour for each point.

    Args:
        points: metres, world frame.
    """

    points: Float[ndarray, "p 3"]
    colours: UInt8[ndarray, "p 3"]


def thinned(mesh: ColouredMesh, most: int = MOST_TRIANGLES) -> ColouredMesh:
    """The mesh with at most so many triangles, by merging the vertices of each cell of a grid.

    Cells keep the resolution of the colours the same everywhere, which merging flat triangles would not.
    """
    if len(mesh.triangles) <= most and len(mesh.vertices) <= MOST_VERTICES:
        return mesh
    edges = np.ptp(mesh.vertices, axis=0).astype(np.float64)
    cell = float(np.sqrt(2 * _area(mesh) / most)) or float(edges.max()) / 100
    while True:
        smaller = _merged(mesh, cell)
        if len(smaller.triangles) <= most and len(smaller.vertices) <= MOST_VERTICES:
            return smaller
        cell *= 1.15


def _area(mesh: ColouredMesh) -> float:
    a, b, c = (mesh.vertices[mesh.triangles[:, i]].astype(np.float64) for i in range(3))
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()) / 2


def _merged(mesh: ColouredMesh, cell: float) -> ColouredMesh:
    low = mesh.vertices.min(axis=0)
    keys = np.floor((mesh.vertices - low) / cell).astype(np.int64)
    size = keys.max(axis=0) + 1
    _, first, group, counts = np.unique(
        (keys[:, 0] * size[1] + keys[:, 1]) * size[2] + keys[:, 2],
        return_index=True,
        return_inverse=True,
        return_counts=True,
    )

    def mean(values: np.ndarray) -> np.ndarray:
        return np.stack([np.bincount(group, values[:, i]) / counts for i in range(3)], axis=1)

    corners = group[mesh.triangles]
    kept = (corners[:, 0] != corners[:, 1]) & (corners[:, 1] != corners[:, 2]) & (corners[:, 2] != corners[:, 0])
    triangles = np.unique(_turned(corners[kept]), axis=0)
    used, triangles = np.unique(triangles, return_inverse=True)
    vertices, colours = mean(mesh.vertices), mean(mesh.colours)
    return ColouredMesh(
        vertices[used],
        triangles.reshape(-1, 3),
        colours[used].round().astype(np.uint8),
        mesh.objects[first[used]],
    )


def _turned(triangles: np.ndarray) -> np.ndarray:
    """The same triangles, each beginning with its smallest index, so that equal ones are equal rows."""
    begin = triangles.argmin(axis=1)
    return np.take_along_axis(triangles, (begin[:, None] + np.arange(3)) % 3, axis=1)


def packed(mesh: ColouredMesh, lines: Lines, up: np.ndarray, eye: np.ndarray) -> dict[str, object]:
    """The data that `surface.js` draws: arrays in base64, and how to take their numbers.

    Args:
        up: unit vector in the world frame.
        eye: where a viewer begins, metres, world frame.
    """
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    scale = float((high - low).max()) or 1.0
    whole = np.round((mesh.vertices - low) / scale * LARGEST).clip(0, LARGEST).astype("<u2")
    return {
        "low": [round(float(x), 5) for x in low],
        "scale": round(scale, 5),
        "high": [round(float(x), 5) for x in high],
        "up": [round(float(x), 5) for x in up],
        "eye": [round(float(x), 4) for x in eye],
        "vertices": _text(whole),
        "triangles": _text(mesh.triangles.astype("<u2")),
        "colours": _text(mesh.colours),
        "objects": _text(mesh.objects),
        "points": _text(lines.points.astype("<f4")),
        "pointColours": _text(lines.colours),
    }


def _text(values: np.ndarray) -> str:
    return base64.b64encode(np.ascontiguousarray(values).tobytes()).decode()


def frusta(
    world_from_cameras: Float[ndarray, "t 4 4"],
    slopes: tuple[float, float],
    length: float,
    colours: UInt8[ndarray, "t 3"],
) -> Lines:
    """The pyramids that cameras look into.

    Args:
        slopes: half the width and height of the image plane at distance 1.
        length: of a pyramid, metres.
    """
    x, y = slopes
    corners = np.array([[-x, -y, 1], [x, -y, 1], [x, y, 1], [-x, y, 1]]) * length
    points = np.concatenate([np.zeros((1, 3)), corners])
    segments = np.array([0, 1, 0, 2, 0, 3, 0, 4, 1, 2, 2, 3, 3, 4, 4, 1])
    world = (
        np.einsum("tij,pj->tpi", world_from_cameras[:, :3, :3], points[segments]) + world_from_cameras[:, None, :3, 3]
    )
    return Lines(world.reshape(-1, 3), np.repeat(colours, len(segments), axis=0))


def box(low: Float[ndarray, "3"], high: Float[ndarray, "3"], colour: tuple[int, int, int]) -> Lines:
    """The edges of an axis-aligned box."""
    corners = np.array([[i >> 2 & 1, i >> 1 & 1, i & 1] for i in range(8)]) * (high - low) + low
    pairs = [(i, i | bit) for i in range(8) for bit in (1, 2, 4) if not i & bit]
    return _coloured(corners[np.array(pairs).ravel()], colour)


def plane_in_box(
    plane: Float[ndarray, "4"],
    low: Float[ndarray, "3"],
    high: Float[ndarray, "3"],
    colour: tuple[int, int, int],
    n_lines: int = 12,
) -> Lines:
    """A grid on the part of a plane that lies in a box.

    Args:
        plane: nx, ny, nz, d with n.x + d = 0.
        n_lines: lines each way.
    """
    normal = plane[:3] / np.linalg.norm(plane[:3])
    centre = (low + high) / 2
    centre = centre - (centre @ normal + plane[3] / np.linalg.norm(plane[:3])) * normal
    right = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
    right /= np.linalg.norm(right)
    axes = (right, np.cross(normal, right))
    reach = float(np.linalg.norm(high - low)) / 2
    ends = []
    for along, across in (axes, axes[::-1]):
        for offset in np.linspace(-reach, reach, n_lines):
            start = centre + offset * across
            # The part of the line start + t along that lies in the box, by its slabs.
            with np.errstate(divide="ignore", invalid="ignore"):
                t = np.sort(np.stack([(low - start) / along, (high - start) / along]), axis=0)
            first, last = np.nanmax(t[0]), np.nanmin(t[1])
            if first < last and np.isfinite([first, last]).all():
                ends += [start + first * along, start + last * along]
    return _coloured(np.array(ends).reshape(-1, 3), colour)


def joined(*lines: Lines) -> Lines:
    """All segments together."""
    return Lines(np.concatenate([each.points for each in lines]), np.concatenate([each.colours for each in lines]))


def _coloured(points: np.ndarray, colour: tuple[int, int, int]) -> Lines:
    return Lines(points, np.tile(np.array(colour, np.uint8), (len(points), 1)))
