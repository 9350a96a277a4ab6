"""Agreement of a mesh and the frames it was fused from, and warnings about it."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from bask_data.kinds import Camera
from bask_data.kinds.reconstruction import FrameRow, UnmeasuredRegion

if TYPE_CHECKING:
    import numpy as np

    from bask_data.core.fit import FacedSurface, Fit, Sketch
    from bask_data.core.tsdf import Mesh

FrameOfCamera = tuple[Camera, int]
"""A camera and the number of one of its frames."""

N_SEARCHED = 48
"""Frames kept in finer sketches, to search for regions that no camera measured. Chosen to bound time, sensitivity not
measured."""

POOR = 0.6
"""Share of the depth on the mesh below which all poses, or the depth scale, are in doubt. Chosen, sensitivity not
measured."""


def spread_evenly(n: int, n_chosen: int) -> list[int]:
    """At most `n_chosen` of n numbers, evenly spread, the first and the last among them."""
    import numpy as np

    return sorted({int(k) for k in np.linspace(0, n - 1, n_chosen).round()}) if n else []


@dataclass(frozen=True)
class Note:
    """Data kept of a frame after fusion: a few kilobytes."""

    fused: bool
    valid_depth: float
    sketch: Sketch


@dataclass(frozen=True)
class Assessment:
    """Agreement of the mesh and the frames, and the regions that no frame measured."""

    rows: list[FrameRow]
    seen_from_behind: float
    unmeasured: list[UnmeasuredRegion]


@dataclass(frozen=True)
class Comparison:
    """A mesh for ray casting, and its agreement with every frame."""

    surface: FacedSurface
    fits: list[Fit]


def compared(frames: list[FrameOfCamera], notes: list[Note], mesh: Mesh, bounds: np.ndarray) -> Comparison:
    """Every frame compared with a mesh, by the few rays of its sketch.

    Args:
        bounds: (2, 3) of the workspace, world frame, metres.
    """
    from bask_data.core import fit

    surface = fit.FacedSurface(mesh.vertices, mesh.triangles)
    fits = [
        fit.fit(note.sketch, camera.Ks[i_frame], camera.world_from_cameras[i_frame], surface, bounds)
        for (camera, i_frame), note in zip(frames, notes, strict=True)
    ]
    return Comparison(surface, fits)


def assessed(
    frames: list[FrameOfCamera],
    notes: list[Note],
    comparison: Comparison,
    bounds: np.ndarray,
    suspects: set[tuple[str, int]],
    dropped: bool,
) -> Assessment:
    """The report on the mesh and the frames that were compared with it.

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
            n_judged=agreement.n_judged,
            explained=agreement.explained,
            residual=agreement.residual,
            residual_abs=agreement.residual_abs,
            from_behind=agreement.from_behind,
        )
        for (camera, i_frame), note, agreement in zip(frames, notes, comparison.fits, strict=True)
    ]
    # Read before further rays are cast, whose hits would count.
    from_behind = comparison.surface.area_from_behind
    return Assessment(rows, from_behind, _unmeasured(frames, notes, comparison.surface, bounds))


def suspects_of(frames: list[FrameOfCamera], fits: list[Fit], hung: set[tuple[str, int]]) -> set[tuple[str, int]]:
    """Camera and number of the frames that the mesh explains far worse than others of the same camera.

    Args:
        hung: frames whose pose hangs, by `hanging_poses`. They are suspects, and no others are compared with them.
    """
    import numpy as np

    from bask_data.core import fit

    found = set(hung)
    for name in {camera.name for camera, _ in frames}:
        own = [
            (i_frame, one)
            for (camera, i_frame), one in zip(frames, fits, strict=True)
            if camera.name == name and (name, i_frame) not in hung
        ]
        odd = fit.outliers(
            np.array([one.n_judged for _, one in own]),
            np.array([one.explained for _, one in own]),
            np.array([one.residual_abs for _, one in own]),
        )
        found |= {(name, own[k][0]) for k in np.flatnonzero(odd)}
    return found


def _unmeasured(
    frames: list[FrameOfCamera], notes: list[Note], surface: FacedSurface, bounds: np.ndarray
) -> list[UnmeasuredRegion]:
    from bask_data.core import fit, unmeasured

    views = []
    for k in spread_evenly(len(frames), N_SEARCHED):
        (camera, i_frame), sketch = frames[k], notes[k].sketch
        world_from_camera = camera.world_from_cameras[i_frame]
        mesh_depth, _ = surface.cast(fit.sketch_rays(sketch, camera.Ks[i_frame], world_from_camera))
        mesh_depth = mesh_depth.reshape(sketch.depth.shape)
        views.append(unmeasured.SketchedView(sketch, camera.Ks[i_frame], world_from_camera, mesh_depth))
    return [
        UnmeasuredRegion(centre=region.centre, size=region.size, volume=region.volume)
        for region in unmeasured.unmeasured_regions(views, bounds)
    ]


def warnings_of(assessment: Assessment, near: float, far: float, hung: set[tuple[str, int]]) -> list[str]:
    """Warnings for the user, with what to do, but for those of the frames whose pose hangs."""
    rows, warnings = assessment.rows, []
    if blind := [row for row in rows if row.valid_depth == 0]:
        warnings.append(
            f"{len(blind)} of {len(rows)} frames have no depth between {near:g} and {far:g} m and were "
            f"skipped: {_listed(blind)}."
        )
    usual, error = median(row.explained for row in rows), median(row.residual_abs for row in rows)
    if usual is not None and error is not None and usual < POOR:
        warnings.append(
            f"only {usual:.0%} of the depth lies on the surface, it is off by {100 * error:.1f} cm in the median: "
            "check the camera poses, the depth scale and the intrinsics, or the sensor is that noisy."
        )
    if suspects := [row for row in rows if row.suspect and (row.camera, row.frame) not in hung]:
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


def median(values: Iterable[float]) -> float | None:
    """The median of the numbers among the values; None if there is none."""
    import numpy as np

    known = [value for value in values if not math.isnan(value)]
    return round(float(np.median(known)), 6) if known else None
