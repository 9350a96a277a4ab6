"""Pixels of two views that show the same point."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import Field

from bask_data.errors import BadData
from bask_data.kinds import Camera, Correspondences, ObjectInstances, PairRow, Reconstruction, Scan, VisibleMasks
from bask_data.kinds.masks import CameraMasks
from bask_data.stage import Params, progress, stage

if TYPE_CHECKING:
    import numpy as np

    from bask_data.core.correspondences import Surface, View
    from bask_data.core.views import Pairs

N_SURFACE_POINTS = 512
"""Points on the objects by which the overlap of two frames is judged."""
FAR = 10.0
"""Depth above this counts as not measured, metres."""
N_FRAMES_KEPT = 64
"""Prepared frames kept in memory, 2 MB each at 640x480; pairs come sorted by their first frame."""


class CorrespondencesParams(Params):
    """What changes the matches."""

    n_pairs: int = Field(200, ge=1, description="Pairs of frames, at most.")
    n_matches: int = Field(1000, ge=1, description="Matches per pair, at most, balanced over the objects.")
    n_attempts: int = Field(4000, ge=1, description="Pixels tried per pair.")
    min_distance: float = Field(
        0.2, ge=0, description="Cameras of a pair are so far apart, metres, or see --min-angle-deg."
    )
    min_angle_deg: float = Field(
        20.0, ge=0, description="Cameras of a pair differ by so much, degrees, or see --min-distance."
    )
    min_overlap: float = Field(
        0.15, ge=0, le=1, description="Share of the objects' surface seen by either frame that both must see."
    )
    tolerance: float = Field(
        0.005, ge=0, description="Depths agree within this, metres, plus the part that grows with depth."
    )
    tolerance_per_metre: float = Field(
        0.01, ge=0, description="Part of that tolerance that grows with depth, metres per metre."
    )
    max_cycle: float = Field(0.7, ge=0, description="A match leads back to within so many pixels.")
    margin: int = Field(2, ge=0, description="Pixels to stay away from the edge of a mask.")
    use_surface: bool = Field(
        True,
        description="Take depth from the reconstruction, held against the measured one; else the measured one alone.",
    )
    seed: int = Field(0, ge=0, description="Seed of the random choices.")


@stage(makes=Correspondences, version=1)
def correspondences(
    scan: Scan,
    reconstruction: Reconstruction,
    objects: ObjectInstances,
    masks: VisibleMasks,
    params: CorrespondencesParams,
    out: Path,
) -> None:
    """Match pixels of the objects between pairs of frames that see them from different places.

    A match must land in the image, unhidden by what the surface and the measured depth show, on the same object, and
    lead back to where it came from. Rejections are counted by reason.
    """
    import numpy as np

    from bask_data.core.correspondences import REJECTIONS, Surface, match

    _check(scan, masks)
    cameras = [(camera, masks.camera(camera.name)) for camera in scan.cameras]
    frames = [(i_camera, i) for i_camera, (camera, _) in enumerate(cameras) for i in range(camera.n_frames)]
    rng = np.random.default_rng(params.seed)
    chosen = _choose(scan, reconstruction, objects, masks, params, rng)
    has_surface = params.use_surface and len(reconstruction.triangles) > 0
    surface = Surface(reconstruction.vertices, reconstruction.triangles) if has_surface else None
    ready = lru_cache(maxsize=N_FRAMES_KEPT)(lambda i_camera, i: _view(*cameras[i_camera], i, surface, params))
    rejections = Counter(dict.fromkeys(REJECTIONS, 0))

    def matched() -> Iterator[tuple[PairRow, dict[str, np.ndarray]]]:
        rows = zip(chosen.frames.tolist(), chosen.distance.tolist(), chosen.angle.tolist(), strict=True)
        for (a, b), distance, angle in progress(list(rows), "matching pairs"):
            found = match(
                ready(*frames[a]),
                ready(*frames[b]),
                rng,
                params.n_attempts,
                params.n_matches,
                (params.tolerance, params.tolerance_per_metre),
                params.max_cycle,
            )
            rejections.update(found.rejections)
            (camera_a, frame_a), (camera_b, frame_b) = frames[a], frames[b]
            row = PairRow(
                camera_a=cameras[camera_a][0].name,
                frame_a=frame_a,
                camera_b=cameras[camera_b][0].name,
                frame_b=frame_b,
                n_attempts=found.n_attempts,
                distance=distance,
                angle=angle,
            )
            (u_a, v_a), (u_b, v_b) = found.uv_a.T, found.uv_b.T
            yield row, {"instance": found.instance, "u_a": u_a, "v_a": v_a, "u_b": u_b, "v_b": v_b}

    Correspondences.write(out, matched(), rejections, warnings=_warnings(chosen, params))


def _check(scan: Scan, masks: VisibleMasks) -> None:
    for camera in scan.cameras:
        n_masks = masks.camera(camera.name).n_frames
        if n_masks != camera.n_frames:
            raise BadData(
                masks.path,
                camera.name,
                expected=f"masks of the {camera.n_frames} frames of the scan",
                got=n_masks,
                fix="run the stage `masks` again.",
            )


def _choose(
    scan: Scan,
    reconstruction: Reconstruction,
    objects: ObjectInstances,
    masks: VisibleMasks,
    params: CorrespondencesParams,
    rng: np.random.Generator,
) -> Pairs:
    """The pairs of frames to match, judged by points on the objects; no frame is read for it."""
    import numpy as np

    from bask_data.core.objects import vertex_normals_and_areas
    from bask_data.core.views import choose_pairs, seen

    normals, areas = vertex_normals_and_areas(reconstruction.vertices, reconstruction.triangles)
    weight = np.where(objects.vertex_instance > 0, areas, 0.0)
    drawn = np.zeros(0, np.int64)
    if weight.sum() > 0:
        drawn = rng.choice(len(weight), size=N_SURFACE_POINTS, p=weight / weight.sum())
    points, normals = reconstruction.vertices[drawn].astype(np.float64), normals[drawn]
    instance = objects.vertex_instance[drawn]
    is_seen = []
    for camera in scan.cameras:
        shown = seen(points, normals, camera.K, camera.world_from_cameras, camera.height, camera.width)
        if len(drawn):
            # NaN, no projection at all, is not greater than zero either.
            shown &= masks.camera(camera.name).visible_fraction[:, instance - 1] > 0
        is_seen.append(shown)
    return choose_pairs(
        np.concatenate([camera.world_from_cameras for camera in scan.cameras]),
        np.concatenate(is_seen),
        points,
        params.n_pairs,
        rng,
        params.min_distance,
        float(np.deg2rad(params.min_angle_deg)),
        params.min_overlap,
    )


def _view(
    camera: Camera, masks: CameraMasks, i_frame: int, surface: Surface | None, params: CorrespondencesParams
) -> View:
    from bask_data.core import depth
    from bask_data.core.correspondences import view

    measured = depth.in_range(camera.depth(i_frame), 0.0, FAR)
    # Flying pixels go, but gaps are not filled as for fusion: a mean of neighbours is off at every edge of an object.
    measured[depth.flying(measured)] = 0
    return view(
        measured,
        masks.instance(i_frame),
        camera.K,
        camera.world_from_cameras[i_frame],
        surface,
        (params.tolerance, params.tolerance_per_metre),
        params.margin,
    )


def _warnings(chosen: Pairs, params: CorrespondencesParams) -> list[str]:
    if len(chosen.frames) >= params.n_pairs:
        return []
    return [
        f"only {len(chosen.frames)} of {params.n_pairs} pairs of frames: of {chosen.n_looked_at} looked at, "
        f"{chosen.n_too_similar} differ by less than {params.min_distance} m and {params.min_angle_deg} degrees, and "
        f"{chosen.n_too_little_overlap} share less than {params.min_overlap} of the objects' surface"
    ]
