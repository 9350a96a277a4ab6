"""Visible masks of the objects in a scan."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import Field

from bask_data.engine import Params, progress, stage
from bask_data.errors import BadData
from bask_data.kinds import Camera, ObjectInstances, Reconstruction, Scan, VisibleMasks

if TYPE_CHECKING:
    import numpy as np

    from bask_data.core.visibility.completion import Completion
    from bask_data.core.visibility.labelled import LabelledSurface

N_FRAMES_SURVEYED = 16
"""Frames of each camera read beforehand, to estimate its noise, what is fixed to it, and what it saw through. Chosen,
sensitivity not measured."""


class MasksParams(Params):
    """Parameters of the masks."""

    tolerance: float | None = Field(
        None,
        ge=0,
        description="Measured depth and mesh agree within this, metres, plus the part that grows with depth. "
        "Default: from the sensor's noise.",
    )
    tolerance_per_metre: float | None = Field(
        None,
        ge=0,
        description="Part of that tolerance that grows with depth, metres per metre. Default: from the sensor's noise.",
    )
    far: float = Field(10.0, gt=0, description="Depth above this counts as not measured, metres.")
    find_fixed: bool = Field(
        True, description="Detect pixels that show something fixed to the camera, such as a gripper, and unmask them."
    )
    use_colour: bool = Field(
        True, description="Detect occluders without depth where the colour differs from the mesh's, and unmask them."
    )
    fill_holes: bool = Field(
        True, description="Fill holes in the mesh of an object where nothing was measured through them."
    )


@stage(makes=VisibleMasks, version=2)
def masks(scan: Scan, reconstruction: Reconstruction, objects: ObjectInstances, params: MasksParams, out: Path) -> None:
    """Project the objects into every frame, without hidden parts.

    A pixel belongs to the object that its ray meets first, unless the measured depth shows an occluder or contradicts
    the mesh. Pixels without measurement follow the ray, and are marked.
    """
    from bask_data.core.visibility import sensor
    from bask_data.core.visibility.completion import Completion
    from bask_data.core.visibility.labelled import LabelledSurface
    from bask_data.core.visibility.surface import CameraDirections
    from bask_data.core.visibility.visible import MeasuredFrame, visible_instances

    if len(objects.vertex_instance) != len(reconstruction.vertices):
        raise BadData(
            objects.path,
            "vertex_instance",
            expected=f"a label for each of the {len(reconstruction.vertices)} vertices",
            got=len(objects.vertex_instance),
            fix="run the stages `reconstruct` and `objects` again.",
        )
    n_instances = len(objects.instances)
    vertices, labels = reconstruction.vertices, objects.vertex_instance
    surface = LabelledSurface(vertices, reconstruction.triangles, labels, n_instances, reconstruction.colors)
    completion = Completion(vertices, labels, reach=reconstruction.voxel_size) if params.fill_holes else None
    with VisibleMasks.writer(out, n_instances) as writer:
        fixed = {}
        for camera in scan.cameras:
            deviation = sensor.noise(_residuals(camera, surface, params))
            if deviation is not None:
                writer.noise[camera.name] = deviation
            writer.tolerance[camera.name] = _tolerance(
                sensor.tolerance_of(deviation, reconstruction.voxel_size), params
            )
            fixed[camera.name] = _survey(camera, surface, completion, writer.tolerance[camera.name], params)
        if completion is not None:
            completion.finish()
        for camera in scan.cameras:
            directions = CameraDirections(camera.Ks, camera.height, camera.width)
            stream = writer.camera(camera.name, camera.n_frames, camera.height, camera.width)
            for i_frame in progress(range(camera.n_frames), f"masks of {camera.name}"):
                frame = visible_instances(
                    surface,
                    MeasuredFrame(
                        _measured(camera, i_frame, params),
                        directions[i_frame],
                        camera.Ks[i_frame],
                        camera.world_from_cameras[i_frame],
                        camera.rgb(i_frame) if params.use_colour else None,
                    ),
                    writer.tolerance[camera.name],
                    fixed[camera.name],
                    completion,
                )
                stream.append(frame.instance, frame.visible_fraction, frame.measured)
                for reason, n_pixels in frame.n_pixels.items():
                    writer.pixels[reason] = writer.pixels.get(reason, 0) + n_pixels


def _tolerance(found: tuple[float, float], params: MasksParams) -> tuple[float, float]:
    constant = found[0] if params.tolerance is None else params.tolerance
    per_metre = found[1] if params.tolerance_per_metre is None else params.tolerance_per_metre
    return constant, per_metre


def _measured(camera: Camera, i_frame: int, params: MasksParams) -> np.ndarray:
    """Depth of a frame, without a lower limit, because a gripper close to the lens is an occluder, too; flying pixels
    are kept, because at a hand's edge they still show that the object is hidden."""
    from bask_data.core import depth

    return depth.filled(depth.in_range(camera.depth(i_frame), 0.0, params.far))


def _surveyed(camera: Camera) -> list[int]:
    """Frames spread evenly over a camera's path."""
    import numpy as np

    spread = np.linspace(0, camera.n_frames - 1, min(N_FRAMES_SURVEYED, camera.n_frames)).round().astype(int)
    return [int(i_frame) for i_frame in np.unique(spread)]


def _residuals(camera: Camera, surface: LabelledSurface, params: MasksParams) -> np.ndarray:
    import numpy as np

    from bask_data.core.visibility import sensor
    from bask_data.core.visibility.surface import CameraDirections

    directions = CameraDirections(camera.Ks, camera.height, camera.width)
    samples = [
        sensor.residuals(
            surface, _measured(camera, i_frame, params), directions[i_frame], camera.world_from_cameras[i_frame]
        )
        for i_frame in _surveyed(camera)
    ]
    return np.concatenate(samples) if samples else np.zeros((0, 2), np.float32)


def _survey(
    camera: Camera,
    surface: LabelledSurface,
    completion: Completion | None,
    tolerance: tuple[float, float],
    params: MasksParams,
) -> np.ndarray | None:
    """Pixels that show something fixed to the camera; None if these are not wanted. Carves the completion."""
    from bask_data.core.visibility.fixed_to_camera import confirmed, fixed_to_camera
    from bask_data.core.visibility.surface import CameraDirections

    directions = CameraDirections(camera.Ks, camera.height, camera.width)

    def looks() -> Iterator[tuple[np.ndarray, np.ndarray]]:
        for i_frame in _surveyed(camera):
            depth, world_from_camera = _measured(camera, i_frame, params), camera.world_from_cameras[i_frame]
            if completion is not None:
                completion.carve(depth, camera.Ks[i_frame], world_from_camera, tolerance)
            yield camera.rgb(i_frame), confirmed(surface, depth, directions[i_frame], world_from_camera, tolerance)

    fixed = fixed_to_camera(looks(), camera.height, camera.width)
    return fixed if params.find_fixed else None
