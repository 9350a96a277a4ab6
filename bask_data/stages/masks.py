"""Which object each pixel of a scan shows."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import Field

from bask_data.errors import BadData
from bask_data.kinds import Camera, ObjectInstances, Reconstruction, Scan, VisibleMasks
from bask_data.stage import Params, progress, stage

if TYPE_CHECKING:
    import numpy as np

    from bask_data.core.masks import Surface

N_SURVEYED = 16
"""Frames a camera is looked at in the search for what is fixed to it."""


class MasksParams(Params):
    """What changes the masks."""

    tolerance: float = Field(
        0.01,
        ge=0,
        description="Measured depth and mesh agree within this, metres, plus the part that grows with depth.",
    )
    tolerance_per_metre: float = Field(
        0.02, ge=0, description="Part of that tolerance that grows with depth, metres per metre."
    )
    far: float = Field(10.0, gt=0, description="Depth above this counts as not measured, metres.")
    find_fixed: bool = Field(
        True, description="Look for pixels that show something fixed to the camera (a gripper) and keep masks off them."
    )


@stage(makes=VisibleMasks, version=1)
def masks(scan: Scan, reconstruction: Reconstruction, objects: ObjectInstances, params: MasksParams, out: Path) -> None:
    """Project the objects into every frame, hidden parts left out.

    A pixel belongs to the object its ray meets first, unless the measured depth shows something else in front of it
    or the mesh wrong.
    """
    from bask_data.core import depth
    from bask_data.core import masks as core

    if len(objects.vertex_instance) != len(reconstruction.vertices):
        raise BadData(
            objects.path,
            "vertex_instance",
            expected=f"a label for each of the {len(reconstruction.vertices)} vertices",
            got=len(objects.vertex_instance),
            fix="run the stages `reconstruct` and `objects` again.",
        )
    n_instances = len(objects.instances)
    surface = core.Surface(reconstruction.vertices, reconstruction.triangles, objects.vertex_instance, n_instances)
    tolerance = (params.tolerance, params.tolerance_per_metre)
    with VisibleMasks.writer(out, n_instances) as writer:
        for camera in scan.cameras:
            directions = core.ray_directions(camera.K, camera.height, camera.width)
            fixed = None
            if params.find_fixed:
                fixed = core.fixed_to_camera(
                    _surveyed(camera, surface, directions, params), camera.height, camera.width
                )
            stream = writer.camera(camera.name, camera.n_frames, camera.height, camera.width)
            for i_frame in progress(range(camera.n_frames), f"masks of {camera.name}"):
                # Nothing is too near here, a gripper just before the lens is what the measurement is asked for; and a
                # flying pixel at a hand's edge still tells that the object is not seen there.
                measured = depth.filled(depth.in_range(camera.depth(i_frame), 0.0, params.far))
                frame = core.visible_instances(
                    surface, measured, directions, camera.K, camera.world_from_cameras[i_frame], tolerance, fixed
                )
                stream.append(frame.instance, frame.visible_fraction)
                for reason, n_pixels in frame.n_pixels.items():
                    writer.pixels[reason] = writer.pixels.get(reason, 0) + n_pixels


def _surveyed(
    camera: Camera, surface: Surface, directions: np.ndarray, params: MasksParams
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Colour, and where the depth lies on the mesh, of frames spread evenly over a camera's path."""
    import numpy as np

    from bask_data.core import depth
    from bask_data.core import masks as core

    for i_frame in np.unique(np.linspace(0, camera.n_frames - 1, N_SURVEYED).round().astype(int)):
        measured = depth.filled(depth.in_range(camera.depth(i_frame), 0.0, params.far))
        seen = core.confirmed(
            surface,
            measured,
            directions,
            camera.world_from_cameras[i_frame],
            (params.tolerance, params.tolerance_per_metre),
        )
        yield camera.rgb(i_frame), seen
