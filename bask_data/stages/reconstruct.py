"""The reconstructed surface of a scan."""

from __future__ import annotations

import re
from collections.abc import Set
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import BeforeValidator, Discriminator, Field, Tag, field_validator

from bask_data.engine import Params, progress, stage
from bask_data.errors import BadData, UsageError
from bask_data.kinds import Reconstruction, Scan
from bask_data.kinds.reconstruction import Quality
from bask_data.stages.fusion_memory import (
    Survey,
    amount_of_memory,
    memory_limit,
    most_blocks,
    resident_bytes,
    too_large,
)
from bask_data.stages.hanging_poses import hanging_poses, hanging_warnings
from bask_data.stages.mesh_quality import (
    N_SEARCHED,
    FrameOfCamera,
    Note,
    assessed,
    compared,
    median,
    spread_evenly,
    suspects_of,
    warnings_of,
)
from bask_data.stages.proposed_workspace import COARSE, proposed

if TYPE_CHECKING:
    import numpy as np

    from bask_data.core.tsdf import Mesh

N_SURVEYED = 24
"""Frames read before fusion, to estimate the workspace and the size of the volume. Chosen, sensitivity not measured."""

SKETCH_COLUMNS, FINE_SKETCH_COLUMNS = 40, 80
"""Rays across a frame to compare it with the mesh, and to search for unmeasured regions (1,200 and 4,800 rays of a 4:3
image). Chosen to bound time, sensitivity not measured."""

DROPPED_SHARE = 0.2
"""Largest share of the frames that may be dropped as suspect: when more disagree, the whole recording is in doubt.
Chosen, sensitivity not measured."""


def _kind_of_workspace(value: object) -> str:
    """Which of the choices a value is meant to be; an option gives a list of texts."""
    return "auto" if value in ("auto", ["auto"]) else "none" if value is None else ""


Workspace = Annotated[
    Annotated[tuple[float, float, float, float, float, float], Tag("")]
    | Annotated[Literal["auto"], BeforeValidator(lambda _: "auto"), Tag("auto")]
    | Annotated[None, Tag("none")],
    Discriminator(_kind_of_workspace),
]
"""A box, `auto`, or None; errors name the box alone, whose tag is therefore empty."""


class ReconstructParams(Params):
    """Parameters of the mesh."""

    voxel_size: float = Field(0.004, gt=0, description="Edge of a voxel, metres.")
    truncation: float = Field(5.0, ge=1, description="Distance around a surface in which the TSDF is kept, voxels.")
    near: float = Field(0.15, ge=0, description="Depth below this is dropped, metres: it is the robot's own gripper.")
    far: float = Field(4.0, gt=0, description="Depth above this is dropped, metres.")
    workspace: Workspace = Field(
        None,
        description="Box to reconstruct, x_min,y_min,z_min,x_max,y_max,z_max in the world frame, metres; or auto: the "
        "support, found in a coarse surface, and what stands on it. Default: what several frames see.",
    )
    min_views: int = Field(
        3, ge=1, description="Frames that must have measured a surface; at most a tenth of all frames is required."
    )
    min_distance: float = Field(
        0.0, ge=0, description="Skip frames until the camera has moved this far, metres; 0: skip none."
    )
    min_angle_deg: float = Field(
        0.0, ge=0, description="Skip frames until the camera has turned this far, degrees; 0: skip none."
    )
    exclude: tuple[str, ...] = Field(
        (),
        description="Frames to leave out, CAMERA:FRAME or CAMERA:FIRST-LAST, separated by commas: wrist:7,wrist:20-24.",
    )
    drop_suspects: bool = Field(True, description="If a few frames disagree with all others, fuse again without them.")
    # Excluded from the skip key, because it decides whether there is a result, never which.
    max_memory: Annotated[str, BeforeValidator(amount_of_memory)] = Field(
        "",
        exclude=True,
        description="Greatest memory to use: 4GB, 800MB. Default: 80 % of what is free.",
    )

    @field_validator("workspace")
    @classmethod
    def _low_corner_first(cls, box: Workspace) -> Workspace:
        if isinstance(box, tuple) and any(low >= high for low, high in zip(box[:3], box[3:], strict=True)):
            raise ValueError("x_min,y_min,z_min,x_max,y_max,z_max in metres with each minimum below its maximum")
        return box


@stage(makes=Reconstruction, version=4)
def reconstruct(scan: Scan, params: ReconstructParams, out: Path) -> None:
    """Fuse a scan's depth images into a triangle mesh.

    Frames are read one by one and none is kept. Depth out of range and flying pixels are dropped first. Every frame is
    then compared with the mesh.
    """
    if params.near >= params.far:
        raise UsageError("reconstruct", "near", expected=f"less than far ({params.far} m)", got=f"{params.near} m")
    excluded = _excluded(scan, params)
    frames = _frames(scan, params, excluded)
    hanging = hanging_poses(frames)
    hung = {(each.camera, i_frame) for each in hanging for i_frame in each.frames}
    survey, doubts = (
        _on_support(scan, frames, params) if params.workspace == "auto" else (_survey(scan, frames, params), [])
    )
    fusion = _fused(scan, frames, survey, params, hung if params.drop_suspects else set())
    comparison = compared(frames, fusion.notes, fusion.judge, survey.bounds)
    suspects = suspects_of(frames, comparison.fits, hung)
    dropped = params.drop_suspects and 0 < len(suspects - hung) <= DROPPED_SHARE * len(frames)
    mesh = fusion.mesh
    if dropped:
        good = [(camera, i_frame) for camera, i_frame in frames if (camera.name, i_frame) not in suspects]
        del comparison  # Its ray caster would be in memory together with the voxels.
        mesh = _fused(scan, good, survey, params).mesh
    # A single wrong frame among few hides the true surface, so frames are judged by a stricter mesh; the report is
    # about the mesh that is kept.
    if mesh is not fusion.judge:
        comparison = compared(frames, fusion.notes, mesh, survey.bounds)
    assessment = assessed(frames, fusion.notes, comparison, survey.bounds, suspects, dropped)
    lowest, highest = survey.bounds.tolist()
    Reconstruction.write(
        out,
        mesh,
        voxel_size=params.voxel_size,
        bounds=(*lowest, *highest),
        quality=Quality(
            frames=sum(camera.n_frames for camera in scan.cameras),
            frames_excluded=len(excluded),
            frames_of_distinct_views=len(frames),
            frames_fused=sum(row.fused for row in assessment.rows),
            frames_without_depth=sum(note.valid_depth == 0 for note in fusion.notes),
            frames_without_depth_in_the_workspace=sum(
                not note.fused and (camera.name, i_frame) not in hung
                for (camera, i_frame), note in zip(frames, fusion.notes, strict=True)
            ),
            frames_suspect=len(suspects),
            workspace="given" if isinstance(params.workspace, tuple) else "estimated",
            voxel_blocks=fusion.n_blocks,
            explained=median(row.explained for row in assessment.rows),
            residual=median(row.residual for row in assessment.rows),
            residual_abs=median(row.residual_abs for row in assessment.rows),
            seen_from_behind=round(assessment.seen_from_behind, 4),
        ),
        frames=assessment.rows,
        unmeasured=assessment.unmeasured,
        warnings=doubts
        + hanging_warnings(hanging, params.drop_suspects)
        + warnings_of(assessment, params.near, params.far, hung),
    )


# Frames ---------------------------------------------------------------------------------------------------------------


def _excluded(scan: Scan, params: ReconstructParams) -> set[tuple[str, int]]:
    """Camera and number of each frame to leave out."""
    n_frames = {camera.name: camera.n_frames for camera in scan.cameras}
    excluded = set()
    for text in params.exclude:
        name, _, numbers = text.rpartition(":")
        match = re.fullmatch(r"(\d+)(?:-(\d+))?", numbers)
        first, last = (int(match[1]), int(match[2] or match[1])) if match else (1, 0)
        if not (name in n_frames and first <= last < n_frames[name]):
            known = ", ".join(f"{camera}:0-{n - 1}" for camera, n in n_frames.items())
            raise UsageError(
                "reconstruct",
                "exclude",
                expected=f"frames of {scan.path.name}, which has {known}",
                got=text,
                fix="for one scan of several, pass --only or write it under reconstruct@SCENE in params.yaml.",
            )
        excluded |= {(name, i_frame) for i_frame in range(first, last + 1)}
    return excluded


def _frames(scan: Scan, params: ReconstructParams, excluded: set[tuple[str, int]]) -> list[FrameOfCamera]:
    """The frames to fuse: of distinct views, without those left out."""
    import numpy as np

    from bask_data.core import tsdf

    frames = []
    for camera in scan.cameras:
        kept = np.array([i for i in range(camera.n_frames) if (camera.name, i) not in excluded], dtype=np.int64)
        distinct = tsdf.distinct_views(
            camera.world_from_cameras[kept], params.min_distance, float(np.deg2rad(params.min_angle_deg))
        )
        frames += [(camera, int(i_frame)) for i_frame in kept[distinct]]
    if excluded and not frames:
        raise UsageError("reconstruct", "exclude", expected="some frames left", got=",".join(params.exclude))
    return frames


# Workspace and memory -------------------------------------------------------------------------------------------------


def _survey(scan: Scan, frames: list[FrameOfCamera], params: ReconstructParams) -> Survey:
    """Estimate workspace and memory from frames spread evenly over the scan, each pose once.

    Several frames of a camera that does not move would agree on everything, also on the floor behind the table.
    """
    import numpy as np

    from bask_data.core import depth, tsdf, workspace

    poses = {(camera.name, camera.world_from_cameras[i].tobytes()): (camera, i) for camera, i in reversed(frames)}
    moved = list(poses.values())[::-1]
    origin = _origin(scan)
    clouds, touched = [], []
    for i_chosen in progress(spread_evenly(len(moved), N_SURVEYED), "looking over the scan"):
        camera, i_frame = moved[i_chosen]
        measured = depth.cleaned(camera.depth(i_frame), params.near, params.far)
        view = (measured, camera.Ks[i_frame], camera.world_from_cameras[i_frame])
        clouds.append(workspace.sampled_points(*view))
        touched.append(tsdf.touched_blocks(*view, params.voxel_size, params.truncation, origin))
    bounds = workspace.estimated_workspace(clouds, origin=origin)
    if bounds is None:
        raise BadData(
            scan.path,
            "depth",
            expected=f"measurements between near {params.near} m and far {params.far} m",
            got=f"none in {len(clouds)} frames looked at",
            fix="check the depth scale the scan was ingested with, or --near and --far.",
        )
    if isinstance(params.workspace, tuple):
        bounds = np.reshape(params.workspace, (2, 3)).astype(float)
    inside = [blocks[tsdf.blocks_inside(blocks, params.voxel_size, bounds, origin)] for blocks in touched]
    return Survey(
        bounds=bounds,
        blocks=np.unique(np.concatenate(inside), axis=0),
        n_blocks=tsdf.expected_blocks(inside, len(moved)),
        voxel_size=params.voxel_size,
        truncation=params.truncation,
        origin=origin,
    )


def _on_support(scan: Scan, frames: list[FrameOfCamera], params: ReconstructParams) -> tuple[Survey, list[str]]:
    """The survey with the box around the support and what stands on it, from a coarse surface of some frames; and
    warnings if it is doubtful."""
    import numpy as np

    coarse = params.model_copy(update={"voxel_size": COARSE * params.voxel_size, "workspace": None})
    some = [frames[i] for i in spread_evenly(len(frames), N_SURVEYED)]
    mesh = _fused(scan, some, _survey(scan, some, coarse), coarse).mesh
    box, doubt = proposed(mesh, np.stack([camera.world_from_cameras[i] for camera, i in some]))
    corners = None if box is None else tuple(np.round(box, 3).ravel().tolist())
    survey = _survey(scan, frames, params.model_copy(update={"workspace": corners}))
    return survey, [f"workspace: {doubt}"] if doubt else []


def _origin(scan: Scan) -> np.ndarray:
    """Where the lattice of voxels begins, world frame, metres: at the first camera, so that a scene gives the same
    surface wherever its world has its origin."""
    return scan.cameras[0].world_from_cameras[0, :3, 3]


# Fusion ---------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Fusion:
    """The mesh of all frames, the mesh to judge them by, a note of each, and the number of voxel blocks."""

    mesh: Mesh
    judge: Mesh
    notes: list[Note]
    n_blocks: int


def _fused(
    scan: Scan,
    frames: list[FrameOfCamera],
    survey: Survey,
    params: ReconstructParams,
    left_out: Set[tuple[str, int]] = frozenset(),
) -> _Fusion:
    """The frames fused, without those left out, of which there is a note only."""
    import numpy as np

    from bask_data.core import depth, fit, tsdf

    most = most_blocks(survey, params.max_memory)
    volume = tsdf.Volume(
        params.voxel_size, params.truncation, survey.bounds, survey.n_blocks, most, origin=survey.origin
    )
    fine = set(spread_evenly(len(frames), N_SEARCHED))
    notes = []
    for k, (camera, i_frame) in enumerate(progress(frames, "fusing frames")):
        raw = camera.depth(i_frame)
        measured = depth.cleaned(raw, params.near, params.far)
        try:
            fused = (camera.name, i_frame) not in left_out and volume.integrate(
                measured, camera.rgb(i_frame), camera.Ks[i_frame], camera.world_from_cameras[i_frame]
            )
        except tsdf.VolumeTooLarge as error:
            limit, begun = memory_limit(params.max_memory), resident_bytes() - volume.n_blocks * tsdf.BLOCK_BYTES
            raise too_large(error.n_needed * len(frames) // (k + 1), begun, limit, survey) from None
        columns = FINE_SKETCH_COLUMNS if k in fine else SKETCH_COLUMNS
        notes.append(
            Note(
                fused,
                float(np.count_nonzero(measured)) / measured.size,
                fit.sketch(raw, measured, params.far, columns),
            )
        )
    n_blocks, judge = volume.n_blocks, None
    if volume.views_needed(params.min_views, 2) > volume.views_needed(params.min_views):
        judge = volume.mesh(params.min_views, 2)
    mesh = volume.mesh(params.min_views, release=True)
    if len(mesh.triangles) == 0:
        raise BadData(
            scan.path,
            "surface",
            expected="a surface inside the workspace",
            got=f"none from {volume.n_integrated} of {len(frames)} frames",
            fix="check --workspace (world frame, metres), or leave it out to have it estimated.",
        )
    return _Fusion(mesh, judge if judge is not None and len(judge.triangles) else mesh, notes, n_blocks)
