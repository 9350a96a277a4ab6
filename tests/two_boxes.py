"""Two boxes on a table, one before the other: an exact mesh of them, and the camera that sees them so."""

from __future__ import annotations

import numpy as np

from bask_data.core.visibility.labelled import LabelledSurface
from bask_data.core.visibility.surface import ray_directions
from bask_data.core.visibility.visible import MeasuredFrame, VisibleFrame, visible_instances
from tests.scenes import Box, Plane, Scene, intrinsics, look_at

HEIGHT, WIDTH = 120, 160

K = intrinsics(HEIGHT, WIDTH)

DIRECTIONS = ray_directions(K, HEIGHT, WIDTH)

TOLERANCE = (0.01, 0.01)


def box_at(x: float, y: float, half: tuple[float, float, float] = (0.04, 0.04, 0.04)) -> Box:
    world_from_box = np.eye(4)
    world_from_box[:3, 3] = x, y, half[2]
    return Box(half, world_from_box)


FRONT, BACK = box_at(0.0, -0.1), box_at(0.0, 0.1, (0.06, 0.04, 0.06))

SCENE = Scene((FRONT, BACK), (Plane(extent=0.5),))

CAMERA = look_at((0.05, -0.7, 0.25))
"""From here the front box hides a part of the back one."""


def mesh_of(
    bodies: tuple[Box, ...], labels: list[int], with_table: bool = True, colors: np.ndarray | None = None
) -> LabelledSurface:
    """The exact surface as triangles: boxes and a table."""
    vertices, triangles, vertex_label = [], [], []
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    faces = [
        [0, 1, 3],
        [0, 3, 2],
        [4, 6, 7],
        [4, 7, 5],
        [0, 4, 5],
        [0, 5, 1],
        [2, 3, 7],
        [2, 7, 6],
        [0, 2, 6],
        [0, 6, 4],
    ]
    faces += [[1, 5, 7], [1, 7, 3]]
    for body, label in zip(bodies, labels, strict=True):
        triangles += [[corner + 8 * len(vertices) for corner in face] for face in faces]
        vertices.append(corners * body.half @ body.world_from_box[:3, :3].T + body.world_from_box[:3, 3])
        vertex_label += [label] * 8
    n_vertices = 8 * len(bodies)
    if with_table:
        vertices.append(np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], float))
        triangles += [[n_vertices, n_vertices + 1, n_vertices + 2], [n_vertices, n_vertices + 2, n_vertices + 3]]
        vertex_label += [0] * 4
    return LabelledSurface(
        np.concatenate(vertices).astype(np.float32),
        np.array(triangles, np.int32),
        np.array(vertex_label, np.int32),
        max(labels, default=0),
        colors,
    )


def look(
    surface: LabelledSurface,
    depth: np.ndarray,
    camera: np.ndarray = CAMERA,
    rgb: np.ndarray | None = None,
    **more: object,
) -> VisibleFrame:
    return visible_instances(surface, MeasuredFrame(depth, DIRECTIONS, K, camera, rgb), TOLERANCE, **more)


NOT_MEASURED = np.zeros((HEIGHT, WIDTH), np.float32)
