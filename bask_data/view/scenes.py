"""Surfaces and objects of a scene, and the first viewpoint."""

from __future__ import annotations

from typing import Any

import numpy as np

from bask_data.core.geometry import transform, unproject
from bask_data.dataset import Dataset
from bask_data.drawing.colours import instance_colours
from bask_data.drawing.mesh import up_direction
from bask_data.evaluation.lookup import find, spread_frames
from bask_data.kinds import InstanceRow, ObjectInstances, Reconstruction, Recording
from bask_data.view.sheet import DrawnItem, Eye, Sheet, expect, label_colour, name_labels, reading

N_EYE_POINTS = 20_000
"""Vertices that locate the scene, at most: more do not change its 2nd and 98th percentiles."""
FAR_ENOUGH = 1.9
"""Distance, in radii of a ball, at which a field of view of 55 degrees shows nearly all of it."""

WORKSPACE_COLOUR = (150, 150, 160)
"""RGB of the workspace box: grey, so that it is told from the objects' boxes. Chosen."""
AXIS_SHARE = 0.2
"""Length of the world's axes over the shortest edge of the workspace. Chosen."""


def draw_scene(sheet: Sheet, drawn: DrawnItem, dataset: Dataset, name: str) -> np.ndarray:
    """Draw the mesh in its colours and by instance, with a box around each; returns its vertices (n, 3)."""
    mesh, objects = find(dataset, Reconstruction, name), find(dataset, ObjectInstances, name)
    vertices = np.zeros((0, 3), np.float32)
    if mesh is not None:
        with reading(mesh):
            vertices = expect(mesh.path, "vertices", mesh.vertices, (None, 3), "f")
            expect(mesh.path, "colors", mesh.colors, (len(vertices), 3), "u")
            expect(mesh.path, "triangles", mesh.triangles, (None, 3), "iu")
            if len(mesh.triangles):
                sheet.fix(("world", "surface"), _mesh(mesh, mesh.colors))
        _draw_workspace(sheet, mesh)
    drawn.note(bool(len(vertices)), "surface", "the mesh is empty" if mesh else "bask-data reconstruct")
    if objects is None:
        drawn.shown.missing.append("instances (bask-data objects)")
        return vertices
    with reading(objects):
        name_labels(sheet, [("world",)], {row.id: row.name for row in objects.instances})
        instance = expect(objects.path, "vertex_instance", objects.vertex_instance, (None,), "i")
        fits = mesh is not None and len(instance) == len(vertices)
        if mesh is not None and fits and len(mesh.triangles):
            normals = _vertex_normals(vertices, mesh.triangles)
            sheet.fix(("world", "instances"), _mesh(mesh, instance_colours(instance, mesh.colors), normals))
            _draw_boxes(sheet, objects, vertices)
    drawn.note(fits, "instances", "made from another reconstruction; bask-data run")
    return vertices


def _mesh(mesh: Reconstruction, colours: np.ndarray, normals: np.ndarray | None = None) -> Any:
    """The mesh with front faces only: from outside, a room's walls do not hide what is inside."""
    import rerun as rr

    return rr.Mesh3D(
        vertex_positions=mesh.vertices,
        triangle_indices=mesh.triangles,
        vertex_colors=colours,
        vertex_normals=normals,
        face_rendering=rr.components.MeshFaceRendering.Front,
    )


def _draw_workspace(sheet: Sheet, mesh: Reconstruction) -> None:
    """Draw the workspace box with its lowest and highest corner in numbers, to copy for `--workspace`, and the world's
    axes there."""
    import rerun as rr

    low, high = np.reshape(mesh.metadata.bounds, (2, 3))
    sheet.fix(
        ("world", "workspace"),
        rr.Boxes3D(
            mins=[low], sizes=[high - low], colors=[WORKSPACE_COLOUR], radii=rr.Radius.ui_points(0.7), show_labels=False
        ),
    )
    corners = [",".join(f"{x:.2f}" for x in corner) for corner in (low, high)]
    sheet.fix(
        ("world", "workspace", "corners"),
        rr.Points3D(
            [low, high],
            labels=[f"lowest {corners[0]}", f"highest {corners[1]}"],
            colors=[WORKSPACE_COLOUR],
            radii=rr.Radius.ui_points(3.0),
            show_labels=True,
        ),
    )
    length = AXIS_SHARE * float((high - low).min())
    sheet.fix(
        ("world", "workspace", "axes"),
        rr.Arrows3D(
            origins=np.tile(low, (3, 1)),
            vectors=length * np.eye(3),
            labels=["x", "y", "z"],
            colors=[(220, 60, 60), (60, 170, 60), (70, 110, 230)],
        ),
    )


def _vertex_normals(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Unit normals (n, 3) float32, with triangles weighted by their area."""
    a, b, c = (vertices[triangles[:, i]] for i in range(3))
    of_triangles = np.cross(b - a, c - a)
    normals = np.zeros((len(vertices), 3))
    for axis in range(3):
        for corner in range(3):
            normals[:, axis] += np.bincount(triangles[:, corner], of_triangles[:, axis], len(vertices))
    return (normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)).astype(np.float32)


def _draw_boxes(sheet: Sheet, objects: ObjectInstances, vertices: np.ndarray) -> None:
    """Draw the box around each object's vertices, along the world's axes."""
    import rerun as rr

    rows = [(row, vertices[objects.vertex_instance == row.id]) for row in objects.instances]
    boxes = [(row, points.min(axis=0), points.max(axis=0)) for row, points in rows if len(points)]
    if not boxes:
        return
    sheet.fix(
        ("world", "boxes"),
        rr.Boxes3D(
            mins=[low for _, low, _ in boxes],
            sizes=[high - low for _, low, high in boxes],
            labels=[_label(row) for row, _, _ in boxes],
            colors=[label_colour(row.id) for row, _, _ in boxes],
            radii=rr.Radius.ui_points(1.0),
            fill_mode="MajorWireframe",
        ),
    )


def _label(row: InstanceRow) -> str:
    """Name of an object, with why it is doubted."""
    return (row.name or f"object {row.id}") + (f" ({row.reasons})" if row.flags else "")


def support_plane(dataset: Dataset, name: str) -> np.ndarray | None:
    """Support plane (4,) of the scene's objects, or None without objects."""
    objects = find(dataset, ObjectInstances, name) if name in dataset.file.scenes else None
    if objects is None:
        return None
    with reading(objects):
        return expect(objects.path, "support_plane", objects.support_plane, (4,), "f")


def measured_points(source: Recording) -> np.ndarray:
    """Points (n, 3) that the first camera measured in a few frames, metres, world frame."""
    points = [np.zeros((0, 3))]
    for camera in source.cameras[:1]:
        for i_frame in spread_frames(camera.n_frames, 3):
            depth = camera.depth(i_frame)[::8, ::8].astype(np.float64)
            v, u = np.nonzero(depth > 0)
            in_camera = unproject(np.stack([u, v], axis=1) * 8.0, depth[v, u], camera.Ks[i_frame])
            points.append(transform(camera.world_from_cameras[i_frame], in_camera))
    return np.concatenate(points)


def first_eye(points: np.ndarray, source: Recording, support: np.ndarray | None) -> Eye | None:
    """The first viewpoint: above the cameras' side of the scene, far enough away to see all of it."""
    poses = np.concatenate([np.zeros((0, 4, 4)), *(camera.world_from_cameras for camera in source.cameras)])
    if not len(points) or not len(poses):
        return None
    up = up_direction(support, poses)
    sample = points[:: max(len(points) // N_EYE_POINTS, 1)].astype(np.float64)
    low, high = np.percentile(sample, [2, 98], axis=0)
    centre, radius = (low + high) / 2, max(float(np.linalg.norm(high - low)) / 2, 0.05)
    eyes = poses[:, :3, 3]
    level = eyes.mean(axis=0) - centre
    level -= (level @ up) * up
    if np.linalg.norm(level) < 0.1 * radius:  # Recorded from straight above or from the inside.
        level = poses[0, :3, 1] - (poses[0, :3, 1] @ up) * up
    length = float(np.linalg.norm(level))
    level = level / length if length > 1e-6 else np.linalg.svd(up[None])[2][1]
    # Distant cameras would shrink the surface to a dot.
    near = eyes[np.linalg.norm(eyes - centre, axis=1) < 4 * radius]
    low, high = np.min([low, *near], axis=0), np.max([high, *near], axis=0)
    target, radius = (low + high) / 2, float(np.linalg.norm(high - low)) / 2
    elevation = np.deg2rad(35)
    side = 0.5 * np.cross(up, level)
    direction = np.cos(elevation) * (level + side) / np.linalg.norm(level + side) + np.sin(elevation) * up
    return Eye(target + FAR_ENOUGH * radius * direction, target, up)
