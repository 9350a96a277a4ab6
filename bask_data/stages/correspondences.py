"""Matches: pixels of two views that show the same point."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import Field

from bask_data.engine import Params, progress, stage
from bask_data.errors import BadData
from bask_data.kinds import Camera, Correspondences, ObjectInstances, PairRow, Reconstruction, Scan, VisibleMasks
from bask_data.kinds.masks import CameraMasks

if TYPE_CHECKING:
    import numpy as np

    from bask_data.core.correspondences.frame_pairs import FramePairs
    from bask_data.core.correspondences.matchable import MatchableView
    from bask_data.core.correspondences.search import Matches
    from bask_data.core.visibility.surface import Surface

N_SURFACE_POINTS = 512
"""Points on the objects by which the overlap of two frames is estimated. Chosen, sensitivity not measured."""
LEAST_TOLERANCE = (0.005, 0.01)
"""(a, b): depths agree within a + b z metres even on an exact sensor, for the errors of voxels and poses. Assumes a
tabletop. Chosen, sensitivity not measured."""
MATCH_NOISE_SIGMAS = 2.5
"""Standard deviations of the sensor's noise within which depths agree. Chosen; its sensitivity is in
docs/benchmarks.md."""
FAR = 10.0
"""Metres above which depth counts as not measured."""
BYTES_KEPT = 128 * 2**20
"""Memory for prepared frames that later pairs need again; pairs are sorted by their first frame."""
BYTES_PER_PIXEL = 10
"""Memory of a prepared frame: depth, pixels by object, two label images."""
FEW = 0.25
"""Share of the wanted matches below which an object gets a warning. Chosen."""


class CorrespondencesParams(Params):
    """Parameters of the matches."""

    n_pairs: int = Field(200, ge=1, description="Most pairs of frames.")
    n_matches: int = Field(1000, ge=1, description="Most matches per pair, balanced over the objects.")
    n_attempts: int = Field(4000, ge=1, description="Pixels tried per pair.")
    min_distance: float = Field(
        0.2, ge=0, description="Least distance of a pair's cameras, metres; --min-angle-deg is enough instead."
    )
    min_angle_deg: float = Field(
        20.0, ge=0, description="Least angle between a pair's cameras, degrees; --min-distance is enough instead."
    )
    min_overlap: float = Field(
        0.15, ge=0, le=1, description="Least share of the objects' surface seen by either frame that both see."
    )
    tolerance: float | None = Field(
        None,
        ge=0,
        description="Depths agree within this, metres, plus the part that grows with depth. "
        "Default: 0.005, more on a noisy sensor.",
    )
    tolerance_per_metre: float | None = Field(
        None,
        ge=0,
        description="Part of that tolerance that grows with depth, metres per metre. "
        "Default: 0.01, more on a noisy sensor.",
    )
    max_cycle: float = Field(
        0.7, ge=0, description="Greatest error, pixels, of a match projected to the other view and back."
    )
    margin: int = Field(2, ge=0, description="Pixels to stay away from the edge of a mask.")
    use_surface: bool = Field(
        True,
        description="Take depth from the reconstruction, checked against measured depth; else measured depth alone.",
    )
    flagged: bool = Field(
        False,
        description="Match flagged objects, too: cut by the border of what was seen, not standing on the support, "
        "fixed to the camera, or flat on the support.",
    )
    seed: int = Field(0, ge=0, description="Seed of the random choices.")


@stage(makes=Correspondences, version=2)
def correspondences(
    scan: Scan,
    reconstruction: Reconstruction,
    objects: ObjectInstances,
    masks: VisibleMasks,
    params: CorrespondencesParams,
    out: Path,
) -> None:
    """Match pixels of the objects between pairs of frames that see them from different places.

    A match must lie in the image, not be hidden by the surface or the measured depth, be on the same object, and lead
    back to its first pixel. Rejections are counted by reason.
    """
    import numpy as np

    from bask_data.core.correspondences.search import REJECTIONS, match
    from bask_data.core.visibility.surface import Surface

    _check(scan, masks)
    cameras = [(camera, masks.camera(camera.name)) for camera in scan.cameras]
    frames = [(i_camera, i) for i_camera, (camera, _) in enumerate(cameras) for i in range(camera.n_frames)]
    rng = np.random.default_rng(params.seed)
    has_surface = len(reconstruction.triangles) > 0
    surface = Surface(reconstruction.vertices, reconstruction.triangles) if has_surface else None
    wanted = _wanted(objects, params)
    labels = objects.vertex_instance * wanted[objects.vertex_instance]
    chosen = _choose(scan, reconstruction, labels, masks, surface, params, rng)
    depth_from, tolerance = surface if params.use_surface else None, _tolerance(masks, params)
    ready = lru_cache(n_kept(scan))(
        lambda i_camera, i: _view(*cameras[i_camera], i, wanted, depth_from, tolerance, params)
    )
    tally = Tally()
    with Correspondences.writer(out) as writer:
        rows = zip(chosen.frames.tolist(), chosen.distance.tolist(), chosen.angle.tolist(), strict=True)
        for (a, b), distance, angle in progress(rows, "matching pairs", len(chosen.frames)):
            found = match(
                ready(*frames[a]),
                ready(*frames[b]),
                rng,
                params.n_attempts,
                params.n_matches,
                tolerance,
                params.max_cycle,
            )
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
            columns = {"instance": found.instance, "u_a": u_a, "v_a": v_a, "u_b": u_b, "v_b": v_b}
            rejections = {
                (int(k), why): int(n)
                for k, counts in zip(found.tried, found.rejections, strict=True)
                for why, n in zip(REJECTIONS, counts, strict=True)
                if n
            }
            writer.append(row, columns, rejections)
            tally.add(found, params.n_matches)
        writer.warnings += _too_few_pairs(chosen, masks, int(wanted.sum()), params) + tally.warnings(wanted)


@dataclass
class Tally:
    """Counts of each object over all pairs, to report where matches are missing and why."""

    n_pairs: int = 0
    n_empty: int = 0
    asked: Counter[int] = field(default_factory=Counter)
    found: Counter[int] = field(default_factory=Counter)
    rejected: Counter[tuple[int, str]] = field(default_factory=Counter)

    def add(self, matches: Matches, n_matches: int) -> None:
        """Count a pair for which `n_matches` were wanted."""
        from bask_data.core.correspondences.search import REJECTIONS

        self.n_pairs += 1
        self.n_empty += not len(matches.instance)
        for instance, counts in zip(matches.tried.tolist(), matches.rejections.tolist(), strict=True):
            self.asked[instance] += n_matches // len(matches.tried)
            self.found[instance] += int((matches.instance == instance).sum())
            for why, n in zip(REJECTIONS, counts, strict=True):
                self.rejected[instance, why] += n

    def warnings(self, wanted: np.ndarray) -> list[str]:
        """Warnings of pairs without matches, and of wanted objects (k + 1,) with few or none."""
        if not self.n_pairs:
            return []
        said = []
        if self.n_empty:
            said.append(f"{self.n_empty} of {self.n_pairs} pairs of frames have no match")
        for instance in wanted.nonzero()[0].tolist():
            if not self.asked[instance]:
                said.append(
                    f"object {instance} has no match: no pair of frames shows it twice, clear of its mask's edges"
                )
            elif self.found[instance] < FEW * self.asked[instance]:
                reasons = {why: n for (k, why), n in self.rejected.items() if k == instance and n}
                most = max(reasons, key=lambda why: reasons[why], default="too few pixels")
                share = f" ({reasons[most] / sum(reasons.values()):.0%} of {sum(reasons.values())})" if reasons else ""
                said.append(
                    f"object {instance} has {self.found[instance]} of {self.asked[instance]} matches; most pixels that "
                    f"are none: {most}{share}"
                )
        return said


def n_kept(scan: Scan) -> int:
    """Number of prepared frames kept in memory, at least the two of a pair."""
    largest = max((camera.height * camera.width for camera in scan.cameras), default=1)
    return max(2, BYTES_KEPT // (BYTES_PER_PIXEL * largest))


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


def _wanted(objects: ObjectInstances, params: CorrespondencesParams) -> np.ndarray:
    """(k + 1,) uint8: 1 for the instances to match, 0 for the background and those flagged."""
    import numpy as np

    wanted = np.array([False, *(params.flagged or not row.flags for row in objects.instances)])
    return wanted.astype(np.uint8)


def _choose(
    scan: Scan,
    reconstruction: Reconstruction,
    vertex_instance: np.ndarray,
    masks: VisibleMasks,
    surface: Surface | None,
    params: CorrespondencesParams,
    rng: np.random.Generator,
) -> FramePairs:
    """The pairs of frames to match, by points on the objects; no frame is read."""
    import numpy as np

    from bask_data.core.correspondences.frame_pairs import choose_pairs, seen
    from bask_data.core.correspondences.matchable import unhidden
    from bask_data.core.objects import vertex_normals_and_areas

    normals, areas = vertex_normals_and_areas(reconstruction.vertices, reconstruction.triangles)
    weight = np.where(vertex_instance > 0, areas, 0.0)
    drawn = np.zeros(0, np.int64)
    if weight.sum() > 0:
        drawn = rng.choice(len(weight), size=N_SURFACE_POINTS, p=weight / weight.sum())
    points, normals = reconstruction.vertices[drawn].astype(np.float64), normals[drawn]
    instance = vertex_instance[drawn]
    is_seen = []
    for camera in scan.cameras:
        shown = seen(points, normals, camera.Ks, camera.world_from_cameras, camera.height, camera.width)
        if len(drawn) and surface is not None:
            for row, world_from_camera in zip(shown, camera.world_from_cameras, strict=True):
                row[row] = unhidden(surface, points[row], world_from_camera)
            # Occluders that are no part of the surface, such as a hand, count by the masks. NaN, no projection at all,
            # is not greater than zero, either.
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


def _tolerance(masks: VisibleMasks, params: CorrespondencesParams) -> tuple[float, float]:
    """(a, b): depths agree within a + b z metres; by default from the noise of the noisiest camera."""
    noise = masks.metadata.noise.values()
    default = [
        max(least, *(MATCH_NOISE_SIGMAS * sigma[k] for sigma in noise)) if noise else least
        for k, least in enumerate(LEAST_TOLERANCE)
    ]
    return (
        default[0] if params.tolerance is None else params.tolerance,
        default[1] if params.tolerance_per_metre is None else params.tolerance_per_metre,
    )


def _view(
    camera: Camera,
    masks: CameraMasks,
    i_frame: int,
    wanted: np.ndarray,
    surface: Surface | None,
    tolerance: tuple[float, float],
    params: CorrespondencesParams,
) -> MatchableView:
    from bask_data.core import depth
    from bask_data.core.correspondences.matchable import matchable_view

    measured = depth.in_range(camera.depth(i_frame), 0.0, FAR)
    # Flying pixels are removed, but gaps are not filled as for fusion: at an object's edge, a mean of neighbours is
    # wrong. Nor does the surface fill them: where a measurement was removed, either of the two may be wrong.
    flying = depth.flying(measured)
    measured[flying] = 0
    instance = masks.instance(i_frame)
    return matchable_view(
        measured,
        instance * wanted[instance],
        camera.Ks[i_frame],
        camera.world_from_cameras[i_frame],
        surface,
        tolerance,
        params.margin,
        flying,
    )


def _too_few_pairs(chosen: FramePairs, masks: VisibleMasks, n_wanted: int, params: CorrespondencesParams) -> list[str]:
    if masks.n_instances == 0:
        return ["no match: the scene has no object.  fix: look at what `bask-data objects` found."]
    if n_wanted == 0:
        return ["no match: all objects are flagged.  fix: look at them with `bask-data view`, then pass --flagged."]
    if len(chosen.frames) >= params.n_pairs:
        return []
    return [
        f"only {len(chosen.frames)} of {params.n_pairs} pairs of frames: of {chosen.n_looked_at} looked at, "
        f"{chosen.n_too_similar} differ by less than {params.min_distance} m and {params.min_angle_deg} degrees, and "
        f"{chosen.n_too_little_overlap} share less than {params.min_overlap} of the objects' surface"
    ]
