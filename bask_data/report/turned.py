"""The surface of a scene that can be turned on the page, with its cameras, workspace and support plane."""

from __future__ import annotations

import json
from collections.abc import Sequence

import numpy as np

from bask_data.drawing.colours import Colour, instance_colours
from bask_data.drawing.mesh import orbit_views, up_direction
from bask_data.drawing.surface_data import ColouredMesh, box, frusta, joined, packed, plane_in_box, thinned
from bask_data.evaluation.lookup import spread_frames
from bask_data.kinds import Camera, ObjectInstances, Reconstruction

N_FRUSTA = 60
"""Cameras drawn, at most: more hide the surface."""

FRUSTUM_SHARE = 0.05
"""Length of a drawn camera, as a share of the diagonal of what is drawn."""

BOX, PLANE = (120, 150, 200), (110, 200, 170)
"""Colours of the workspace and of the support plane."""


def surface_text(
    mesh: Reconstruction,
    objects: ObjectInstances | None,
    cameras: Sequence[Camera],
    path_colours: tuple[Colour, Colour],
) -> str:
    """What `surface.js` draws, as JSON; empty for an empty mesh.

    Args:
        objects: of this mesh, if there are any.
        path_colours: of the first and last camera.
    """
    if not len(mesh.triangles):
        return ""
    small = thinned(
        ColouredMesh(
            mesh.vertices,
            mesh.triangles,
            mesh.colors,
            mesh.colors if objects is None else instance_colours(objects.vertex_instance, mesh.colors),
        )
    )
    low, high = np.array(mesh.metadata.bounds, np.float64).reshape(2, 3)
    # An estimated workspace may be larger than what was seen in it.
    low = np.maximum(low, mesh.vertices.min(axis=0) - 0.02)
    high = np.minimum(high, mesh.vertices.max(axis=0) + 0.02)
    lines = [box(low, high, BOX)]
    plane = None if objects is None else objects.support_plane
    if plane is not None and np.linalg.norm(plane[:3]) > 0:
        lines.append(plane_in_box(plane, low, high, PLANE))
    length = FRUSTUM_SHARE * float(np.linalg.norm(high - low))
    for camera in cameras:
        chosen = spread_frames(camera.n_frames, max(N_FRUSTA // len(cameras), 1))
        K = camera.Ks[0]
        slopes = (camera.width / 2 / float(K[0, 0]), camera.height / 2 / float(K[1, 1]))
        share = np.linspace(0, 1, len(chosen))[:, None]
        colours = ((1 - share) * np.array(path_colours[0]) + share * np.array(path_colours[1])).astype(np.uint8)
        lines.append(frusta(camera.world_from_cameras[chosen], slopes, length, colours))
    path = np.concatenate([camera.world_from_cameras for camera in cameras]) if cameras else np.eye(4)[None]
    up = up_direction(plane, path)
    first = orbit_views(mesh.vertices, path, up, height=360, width=480)[0]
    return json.dumps(packed(small, joined(*lines), up, first.world_from_camera[:3, 3]))
