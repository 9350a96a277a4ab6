"""A scan's surface."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from pydantic import BeforeValidator, Field, field_validator

from bask_data.engine import Params, progress, stage
from bask_data.errors import BadData, UsageError
from bask_data.kinds import Camera, Reconstruction, Scan
from bask_data.kinds.reconstruction import FrameRow, Quality, UnmeasuredRegion

if TYPE_CHECKING:
    import numpy as np

    from bask_data.core.fit import FacedSurface, Fit, Sketch
    from bask_data.core.tsdf import Mesh

N_SURVEYED = 24
"""Frames looked at before the fusion, to estimate the workspace and the size of the volume."""

N_SEARCHED = 48
"""Frames kept in finer sketches, to search for what no camera can measure."""

SKETCH_COLUMNS, FINE_SKETCH_COLUMNS = 40, 80

WORKING_BYTES = 100 * 2**20
"""What reading and preparing one frame takes on top of the volume."""

USED_SHARE = 0.8
"""Of the memory that is free, unless `max_memory` says otherwise."""

DROPPED_SHARE = 0.2
"""Most of the frames that may be dropped as suspect: when more disagree, the recording as a whole is in doubt."""

POOR = 0.6
"""Share of the depth that lies on the mesh, below which all poses, or the scale of the depth, are in doubt."""

FrameOfCamera = tuple[Camera, int]


def _amount_of_memory(given: object) -> str:
    text = str(given).strip().upper()
    if not re.fullmatch(r"(\d+(\.\d+)?\s*([MG]B)?)?", text):
        raise ValueError("an amount of memory such as 4GB or 800MB")
    return text


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
    exclude: tuple[str, ...] = Field(
        (),
        description="Frames to leave out, CAMERA:FRAME or CAMERA:FIRST-LAST, separated by commas: wrist:7,wrist:20-24.",
    )
    drop_suspects: bool = Field(
        True, description="Fuse again without the frames that disagree with all others, should there be a few."
    )
    # It decides whether there is a result, never which: so it is no part of what the result depends on.
    max_memory: Annotated[str, BeforeValidator(_amount_of_memory)] = Field(
        "",
        exclude=True,
        description="Refuse to take more memory than this: 4GB, 800MB. Default: 80 % of what is free.",
    )

    @field_validator("workspace")
    @classmethod
    def _low_corner_first(cls, box: tuple[float, ...] | None) -> tuple[float, ...] | None:
        if box is not None and any(low >= high for low, high in zip(box[:3], box[3:], strict=True)):
            raise ValueError("x_min,y_min,z_min,x_max,y_max,z_max in metres with each minimum below its maximum")
        return box


@stage(makes=Reconstruction, version=2)
def reconstruct(scan: Scan, params: ReconstructParams, out: Path) -> None:
    """Fuse a scan's depth images into a triangle mesh.

    Frames are read one after the other and none is kept. Depth outside the range and flying pixels at depth edges are
    dropped first. Every frame is then held against the mesh.
    """
    if params.near >= params.far:
        raise UsageError("reconstruct", "near", expected=f"less than far ({params.far} m)", got=f"{params.near} m")
    excluded = _excluded(scan, params)
    frames = _frames(scan, params, excluded)
    survey = _survey(scan, frames, params)
    fusion = _fused(scan, frames, survey, params)
    held = _held(frames, fusion.notes, fusion.judge, survey.bounds)
    suspects = _suspects(frames, held.fits)
    dropped = params.drop_suspects and 0 < len(suspects) <= DROPPED_SHARE * len(frames)
    mesh = fusion.mesh
    if dropped:
        good = [(camera, i_frame) for camera, i_frame in frames if (camera.name, i_frame) not in suspects]
        del held  # What rays need would stand in memory beside the voxels.
        mesh = _fused(scan, good, survey, params).mesh
    # A single wrong frame among few hides the true surface, so frames are judged by a stricter mesh; what is reported
    # of them is about the one that is kept.
    if mesh is not fusion.judge:
        held = _held(frames, fusion.notes, mesh, survey.bounds)
    assessment = _assessed(frames, fusion.notes, held, survey.bounds, suspects, dropped)
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
            frames_without_depth_in_the_workspace=sum(not note.fused for note in fusion.notes),
            frames_suspect=len(suspects),
            workspace="estimated" if params.workspace is None else "given",
            voxel_blocks=fusion.n_blocks,
            explained=_median(row.explained for row in assessment.rows),
            residual=_median(row.residual for row in assessment.rows),
            residual_abs=_median(row.residual_abs for row in assessment.rows),
            seen_from_behind=round(assessment.seen_from_behind, 4),
        ),
        frames=assessment.rows,
        unmeasured=assessment.unmeasured,
        warnings=_warnings(assessment, params),
    )


# Frames ---------------------------------------------------------------------------------------------------------------


def _excluded(scan: Scan, params: ReconstructParams) -> set[tuple[str, int]]:
    """Camera and number of the frames to leave out."""
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


def _spread(n: int, n_chosen: int) -> list[int]:
    """At most `n_chosen` of n numbers, evenly spread, the first and the last among them."""
    import numpy as np

    return sorted({int(k) for k in np.linspace(0, n - 1, n_chosen).round()}) if n else []


# Workspace and memory -------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Survey:
    """What a first look at some frames tells: the workspace (2, 3) in metres, the blocks that these frames touch, and
    how many all will."""

    bounds: np.ndarray
    blocks: np.ndarray
    n_blocks: int


def _survey(scan: Scan, frames: list[FrameOfCamera], params: ReconstructParams) -> _Survey:
    """Look over frames spread evenly over the scan, each pose once.

    A camera that stands still agrees with itself on all it sees, the floor behind the table too.
    """
    import numpy as np

    from bask_data.core import depth, tsdf, workspace

    poses = {(camera.name, camera.world_from_cameras[i].tobytes()): (camera, i) for camera, i in reversed(frames)}
    moved = list(poses.values())[::-1]
    clouds, touched = [], []
    for i_chosen in progress(_spread(len(moved), N_SURVEYED), "looking over the scan"):
        camera, i_frame = moved[i_chosen]
        measured = depth.cleaned(camera.depth(i_frame), params.near, params.far)
        view = (measured, camera.K, camera.world_from_cameras[i_frame])
        clouds.append(workspace.sampled_points(*view))
        touched.append(tsdf.touched_blocks(*view, params.voxel_size, params.truncation))
    bounds = workspace.estimated_workspace(clouds)
    if bounds is None:
        raise BadData(
            scan.path,
            "depth",
            expected=f"measurements between near {params.near} m and far {params.far} m",
            got=f"none in {len(clouds)} frames looked at",
            fix="check the depth scale the scan was ingested with, or --near and --far.",
        )
    if params.workspace is not None:
        bounds = np.reshape(params.workspace, (2, 3)).astype(float)
    inside = [blocks[tsdf.blocks_inside(blocks, params.voxel_size, bounds)] for blocks in touched]
    return _Survey(bounds, np.unique(np.concatenate(inside), axis=0), tsdf.expected_blocks(inside, len(moved)))


def _most_blocks(survey: _Survey, params: ReconstructParams) -> int:
    """Voxel blocks that fit into the memory allowed; refuses when fewer than are expected."""
    from bask_data.core import tsdf

    begun, limit = _resident_bytes(), _memory_limit(params.max_memory)
    n_blocks = min(max(0, int((limit - begun - WORKING_BYTES) / tsdf.peak_bytes(1))), tsdf.MOST_BLOCKS)
    if n_blocks < survey.n_blocks:
        raise _too_large(survey.n_blocks, begun, limit, survey, params)
    return n_blocks


def _too_large(n_blocks: int, begun: int, limit: int, survey: _Survey, params: ReconstructParams) -> UsageError:
    """The refusal, and what would fit."""
    from bask_data.core import tsdf

    needed = begun + WORKING_BYTES + tsdf.peak_bytes(n_blocks)
    remedies = []
    room = min(limit - begun - WORKING_BYTES, tsdf.peak_bytes(tsdf.MOST_BLOCKS))
    if voxel_size := _voxel_size_that_fits(n_blocks, room, survey, params):
        size = " x ".join(f"{edge:.2f}" for edge in survey.bounds[1] - survey.bounds[0])
        remedies += [f"--voxel-size {voxel_size:g}", f"a --workspace smaller than {size} m"]
    if n_blocks > tsdf.MOST_BLOCKS:
        return UsageError(
            "reconstruct",
            "voxel_size",
            expected=f"at most {tsdf.MOST_BLOCKS} voxel blocks, which is what Open3D can count",
            got=f"about {n_blocks} at voxels of {params.voxel_size * 1000:g} mm",
            fix=", or ".join(remedies or ["larger voxels"]) + ".",
        )
    remedies.append(f"--max-memory {_amount(math.ceil(needed * 1.1))}")
    return UsageError(
        "reconstruct",
        "max_memory",
        expected=f"at most {_amount(limit)}",
        got=f"a need of about {_amount(needed)} at voxels of {params.voxel_size * 1000:g} mm",
        fix=", or ".join(remedies) + ".",
    )


def _voxel_size_that_fits(n_blocks: int, n_bytes: int, survey: _Survey, params: ReconstructParams) -> float | None:
    """The smallest, of steps of a tenth, that takes 10 % less than so much memory; None if not ten times as large."""
    from bask_data.core import tsdf

    for factor in (1.1**k for k in range(1, 25)):
        share = tsdf.coarsening(survey.blocks, factor, params.truncation)
        if tsdf.peak_bytes(math.ceil(1.1 * share * n_blocks)) <= n_bytes:
            return math.ceil(params.voxel_size * factor * 1e4) / 1e4
    return None


def _memory_limit(text: str) -> int:
    """Bytes: as given, in GB where no unit is, or a share of what the machine has free and this process holds."""
    match = re.fullmatch(r"([\d.]+)\s*([MG]B)?", text)
    if match:
        return int(float(match[1]) * (1e6 if match[2] == "MB" else 1e9))
    return _resident_bytes() + int(USED_SHARE * _free_bytes())


def _resident_bytes() -> int:
    import psutil

    return int(psutil.Process().memory_info().rss)


def _free_bytes() -> int:
    """Of the machine, or of the container, which the machine's own figures know nothing of."""
    import psutil

    free = int(psutil.virtual_memory().available)
    group = Path("/sys/fs/cgroup")
    try:
        limit = (group / "memory.max").read_text().strip()
        if limit != "max":
            free = min(free, int(limit) - int((group / "memory.current").read_text()))
    except (OSError, ValueError):
        pass  # No Linux, or no container.
    return max(free, 0)


def _amount(n_bytes: int) -> str:
    return f"{n_bytes / 1e9:.2g}GB" if n_bytes >= 1e9 else f"{n_bytes / 1e6:.0f}MB"


# Fusion ---------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Note:
    """What is kept of a frame after it was fused: a few kilobytes."""

    fused: bool
    valid_depth: float
    sketch: Sketch


@dataclass(frozen=True)
class _Fusion:
    """The mesh of all frames, the one to judge them by, a note of each, and the voxel blocks it took."""

    mesh: Mesh
    judge: Mesh
    notes: list[_Note]
    n_blocks: int


def _fused(scan: Scan, frames: list[FrameOfCamera], survey: _Survey, params: ReconstructParams) -> _Fusion:
    import numpy as np

    from bask_data.core import depth, fit, tsdf

    most = _most_blocks(survey, params)
    volume = tsdf.Volume(params.voxel_size, params.truncation, survey.bounds, survey.n_blocks, most)
    fine = set(_spread(len(frames), N_SEARCHED))
    notes = []
    for k, (camera, i_frame) in enumerate(progress(frames, "fusing frames")):
        raw = camera.depth(i_frame)
        measured = depth.cleaned(raw, params.near, params.far)
        try:
            fused = volume.integrate(measured, camera.rgb(i_frame), camera.K, camera.world_from_cameras[i_frame])
        except tsdf.VolumeTooLarge as error:
            limit, begun = _memory_limit(params.max_memory), _resident_bytes() - volume.n_blocks * tsdf.BLOCK_BYTES
            raise _too_large(error.n_needed * len(frames) // (k + 1), begun, limit, survey, params) from None
        columns = FINE_SKETCH_COLUMNS if k in fine else SKETCH_COLUMNS
        notes.append(
            _Note(
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


# Quality --------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Assessment:
    """How the mesh and the frames agree, and where no frame could measure."""

    rows: list[FrameRow]
    seen_from_behind: float
    unmeasured: list[UnmeasuredRegion]


@dataclass(frozen=True)
class _Held:
    """A mesh ready for rays, and every frame held against it."""

    surface: FacedSurface
    fits: list[Fit]


def _held(frames: list[FrameOfCamera], notes: list[_Note], mesh: Mesh, bounds: np.ndarray) -> _Held:
    from bask_data.core import fit

    surface = fit.FacedSurface(mesh.vertices, mesh.triangles)
    fits = [
        fit.fit(note.sketch, camera.K, camera.world_from_cameras[i_frame], surface, bounds)
        for (camera, i_frame), note in zip(frames, notes, strict=True)
    ]
    return _Held(surface, fits)


def _assessed(
    frames: list[FrameOfCamera],
    notes: list[_Note],
    held: _Held,
    bounds: np.ndarray,
    suspects: set[tuple[str, int]],
    dropped: bool,
) -> _Assessment:
    """What is told of the mesh and the frames that were held against it.

    Args:
        suspects: frames that disagree with the others.
        dropped: whether the mesh is without those.
    """
    rows = [
        FrameRow(
            camera=camera.name,
            frame=i_frame,
            fused=note.fused and not (dropped and (camera.name, i_frame) in suspects),
            suspect=(camera.name, i_frame) in suspects,
            valid_depth=note.valid_depth,
            n_judged=one.n_judged,
            explained=one.explained,
            residual=one.residual,
            residual_abs=one.residual_abs,
            from_behind=one.from_behind,
        )
        for (camera, i_frame), note, one in zip(frames, notes, held.fits, strict=True)
    ]
    # Asked before more rays are cast, whose hits would count.
    from_behind = held.surface.area_from_behind
    return _Assessment(rows, from_behind, _unmeasured(frames, notes, held.surface, bounds))


def _suspects(frames: list[FrameOfCamera], fits: list[Fit]) -> set[tuple[str, int]]:
    """Camera and number of the frames that the mesh explains far worse than others of the same camera."""
    import numpy as np

    from bask_data.core import fit

    found: set[tuple[str, int]] = set()
    for name in {camera.name for camera, _ in frames}:
        own = [(i_frame, one) for (camera, i_frame), one in zip(frames, fits, strict=True) if camera.name == name]
        odd = fit.outliers(
            np.array([one.n_judged for _, one in own]),
            np.array([one.explained for _, one in own]),
            np.array([one.residual_abs for _, one in own]),
        )
        found |= {(name, own[k][0]) for k in np.flatnonzero(odd)}
    return found


def _unmeasured(
    frames: list[FrameOfCamera], notes: list[_Note], surface: FacedSurface, bounds: np.ndarray
) -> list[UnmeasuredRegion]:
    from bask_data.core import fit, unmeasured

    views = []
    for k in _spread(len(frames), N_SEARCHED):
        (camera, i_frame), sketch = frames[k], notes[k].sketch
        world_from_camera = camera.world_from_cameras[i_frame]
        mesh_depth, _ = surface.cast(fit.sketch_rays(sketch, camera.K, world_from_camera))
        mesh_depth = mesh_depth.reshape(sketch.depth.shape)
        views.append(unmeasured.SketchedView(sketch, camera.K, world_from_camera, mesh_depth))
    return [
        UnmeasuredRegion(centre=region.centre, size=region.size, volume=region.volume)
        for region in unmeasured.unmeasured_regions(views, bounds)
    ]


def _warnings(assessment: _Assessment, params: ReconstructParams) -> list[str]:
    """What a person should know, with what to do about it."""
    rows, warnings = assessment.rows, []
    if blind := [row for row in rows if row.valid_depth == 0]:
        warnings.append(
            f"{len(blind)} of {len(rows)} frames have no depth between {params.near:g} and {params.far:g} m and were "
            f"skipped: {_listed(blind)}."
        )
    usual, error = _median(row.explained for row in rows), _median(row.residual_abs for row in rows)
    if usual is not None and error is not None and usual < POOR:
        warnings.append(
            f"only {usual:.0%} of the depth lies on the surface, it is off by {100 * error:.1f} cm in the median: "
            "check the camera poses, the depth scale and the intrinsics, or the sensor is that noisy."
        )
    if suspects := [row for row in rows if row.suspect]:
        figures = ", ".join(
            f"{row.camera} {row.frame} ({row.explained:.0%} of its depth on the surface, off by "
            f"{row.residual_abs * 100:.1f} cm)"
            for row in suspects[:5]
        )
        more = f" and {len(suspects) - 5} more" if len(suspects) > 5 else ""
        names = ",".join(f"{row.camera}:{row.frame}" for row in suspects)
        done = (
            "They were left out of the mesh; --no-drop-suspects keeps them."
            if not any(row.fused for row in suspects)
            else f"To leave them out: --exclude {names}"
        )
        warnings.append(
            f"{len(suspects)} of {len(rows)} frames disagree with the others, which have {usual:.0%} on the surface: "
            f"{figures}{more}. Their poses may be wrong, or something moved. {done}"
        )
    for region in assessment.unmeasured:
        centre = ", ".join(f"{x:.2f}" for x in region.centre)
        size = " x ".join(f"{100 * x:.0f}" for x in region.size)
        warnings.append(
            f"the cameras could not measure what stands at {centre} m (about {size} cm): transparent, shiny or black? "
            "Masks there cannot be trusted."
        )
    return warnings


def _listed(rows: list[FrameRow], most: int = 8) -> str:
    names = [f"{row.camera} {row.frame}" for row in rows]
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def _median(values: object) -> float | None:
    """The median of the numbers among the values; None if there is none."""
    import numpy as np

    known = [value for value in values if not math.isnan(value)]  # type: ignore[attr-defined]
    return round(float(np.median(known)), 6) if known else None
