"""The workspace proposed from a coarse surface: the support, and what stands on it."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np

    from bask_data.core.tsdf import Mesh

COARSE = 2.0
"""Voxels of the surface that a workspace is proposed from, over those of the result. Chosen, sensitivity not measured.
"""
SUPPORT_TOLERANCE = 0.01
"""Metres from the support within which surface is on it, as by default in `objects`."""
INSTEAD = "the workspace is what several frames see"
"""What happens without a support."""


def proposed(mesh: Mesh, world_from_cameras: np.ndarray) -> tuple[np.ndarray | None, str]:
    """The box (2, 3) of a support and what stands on it, metres, world; or None, and why it is doubtful.

    Args:
        world_from_cameras: (t, 4, 4), for a guess of up.
    """
    import numpy as np

    from bask_data.core.background import MeshVertices, doubt, support_of_scene
    from bask_data.core.footprint import footprint
    from bask_data.core.objects import vertex_normals_and_areas
    from bask_data.core.planes import on_plane, upward
    from bask_data.core.workspace import workspace_on

    normals, areas = vertex_normals_and_areas(mesh.vertices, mesh.triangles)
    surface = MeshVertices(mesh.vertices.astype(np.float64), normals, areas)
    guess = upward(world_from_cameras)
    support, warnings = support_of_scene(surface, np.random.default_rng(0), None, guess, SUPPORT_TOLERANCE)
    if support is None:
        return None, f"no support was found; {INSTEAD}"
    if reason := doubt(support, surface, SUPPORT_TOLERANCE):
        return None, f"{reason}; {INSTEAD}"
    floor = on_plane(surface.points, normals, support.plane, SUPPORT_TOLERANCE) & (areas > 0)
    ground = footprint(support.plane, surface.points[floor], areas[floor])
    if not len(ground.edges):
        return None, f"the support has no extent; {INSTEAD}"
    box = workspace_on(support.plane, surface.points, floor, ground)
    return box, "; ".join(warnings)
