"""A scan's surface."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import Field, field_validator

from bask_data.errors import BadData, UsageError
from bask_data.kinds import Camera, Reconstruction, Scan
from bask_data.stage import Params, progress, stage

if TYPE_CHECKING:
    import numpy as np

    from bask_data.core.tsdf import Glimpse

N_SURVEYED = 24
"""Frames looked at before the fusion, to estimate the workspace and the size of the volume."""


class ReconstructParams(Params):
    """What changes the mesh."""

    voxel_size: float = Field(0.004, gt=0, description="Edge of a voxel, metres.")
    truncation: float = Field(5.0, ge=1, description="Voxels kept on both sides of a surface.")
    near: float = Field(0.15, ge=0, description="Depth below this is dropped, metres: it is the robot's own gripper.")
    far: float = Field(4.0, gt=0, description="Depth above this is dropped, metres.")
    workspace: tuple[float, float, float, float, float, float] | None = Field(
        None,
        description="Box to reconstruct, x_min,y_min,z_min,x_max,y_max,z_max in the world frame, metres. "
        "Default: what the frames agree on.",
    )
    min_views: int = Field(
        3, ge=1, description="Frames that must have measured a surface; at most a tenth of all frames is asked for."
    )
    min_distance: float = Field(
        0.0, ge=0, description="Skip frames until the camera has moved so far, metres; 0: do not."
    )
    min_angle_deg: float = Field(
        0.0, ge=0, description="Skip frames until the camera has turned so far, degrees; 0: do not."
    )

    @field_validator("workspace")
    @classmethod
    def _low_corner_first(cls, box: tuple[float, ...] | None) -> tuple[float, ...] | None:
        if box is not None and any(low >= high for low, high in zip(box[:3], box[3:], strict=True)):
            raise ValueError("x_min,y_min,z_min,x_max,y_max,z_max in metres with each minimum below its maximum")
        return box


@stage(makes=Reconstruction, version=1)
def reconstruct(scan: Scan, params: ReconstructParams, out: Path) -> None:
    """Fuse a scan's depth images into a triangle mesh.

    Frames are read one after the other and none is kept. Depth outside the range and flying pixels at depth edges are
    dropped first.
    """
    import numpy as np

    from bask_data.core import depth, tsdf

    if params.near >= params.far:
        raise UsageError("reconstruct", "near", expected=f"less than far ({params.far} m)", got=f"{params.near} m")
    frames = [
        (camera, int(i_frame))
        for camera in scan.cameras
        for i_frame in tsdf.distinct_views(
            camera.world_from_cameras, params.min_distance, float(np.deg2rad(params.min_angle_deg))
        )
    ]
    glimpses = list(_survey(frames, params))
    bounds = _bounds(glimpses, params)
    if bounds is None:
        raise BadData(
            scan.path,
            "depth",
            expected=f"measurements between near {params.near} m and far {params.far} m",
            got=f"none in {len(glimpses)} frames looked at",
            fix="check the depth scale the scan was ingested with, or --near and --far.",
        )
    n_blocks = tsdf.expected_blocks(glimpses, params.voxel_size, params.truncation, bounds)
    volume = tsdf.Volume(params.voxel_size, params.truncation, bounds, n_blocks)
    for camera, i_frame in progress(frames, "fusing frames"):
        measured = depth.cleaned(camera.depth(i_frame), params.near, params.far)
        volume.integrate(measured, camera.rgb(i_frame), camera.K, camera.world_from_cameras[i_frame])
    mesh = volume.mesh(params.min_views)
    if len(mesh.triangles) == 0:
        raise BadData(
            scan.path,
            "surface",
            expected="a surface inside the workspace",
            got=f"none from {volume.n_integrated} of {len(frames)} frames",
            fix="check --workspace (world frame, metres), or leave it out to have it estimated.",
        )
    lowest, highest = bounds.tolist()
    Reconstruction.write(
        out,
        vertices=mesh.vertices,
        triangles=mesh.triangles,
        colors=mesh.colors,
        voxel_size=params.voxel_size,
        bounds=(*lowest, *highest),
        quality={
            "frames": sum(camera.n_frames for camera in scan.cameras),
            "frames_of_distinct_views": len(frames),
            "frames_fused": volume.n_integrated,
            "frames_without_depth_in_the_workspace": len(frames) - volume.n_integrated,
            "workspace": "estimated" if params.workspace is None else "given",
        },
    )


def _survey(frames: list[tuple[Camera, int]], params: ReconstructParams) -> Iterator[Glimpse]:
    """Thinned-out points of frames spread evenly over the scan."""
    import numpy as np

    from bask_data.core import depth, tsdf

    chosen = np.linspace(0, len(frames) - 1, N_SURVEYED).round().astype(int)
    for i_chosen in progress(np.unique(chosen) if frames else [], "looking over the scan"):
        camera, i_frame = frames[i_chosen]
        measured = depth.cleaned(camera.depth(i_frame), params.near, params.far)
        yield tsdf.glimpse(measured, camera.K, camera.world_from_cameras[i_frame])


def _bounds(glimpses: list[Glimpse], params: ReconstructParams) -> np.ndarray | None:
    import numpy as np

    from bask_data.core import tsdf

    if params.workspace is not None:
        return np.reshape(params.workspace, (2, 3)).astype(float)
    return tsdf.estimated_workspace(glimpses)
