"""Visible masks: the object that each pixel shows, from the ray to the mesh and the measured depth together."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8
from numpy import ndarray

from bask_data.core.compiled import compiled
from bask_data.core.visibility.completion import Completion
from bask_data.core.visibility.decision import Decision, decided
from bask_data.core.visibility.foreign import foreign
from bask_data.core.visibility.labelled import N_AMODAL_RAYS, LabelledImage, LabelledSurface
from bask_data.core.visibility.sensor import MASK_TOLERANCE
from bask_data.core.visibility.surface import Rays, rays_of


@dataclass(frozen=True)
class VisibleFrame:
    """One frame's masks.

    Args:
        measured: False where an object was a candidate and nothing was measured: the ray alone decided, or
            measurements around, or the colour.
        visible_fraction: share of each instance's own projection that is visible, in [0, 1]; NaN where it has none.
        n_pixels: pixels by how they were decided.
    """

    instance: UInt8[ndarray, "h w"]
    measured: Bool[ndarray, "h w"]
    visible_fraction: Float32[ndarray, "k"]
    n_pixels: dict[str, int]


@dataclass(frozen=True)
class MeasuredFrame:
    """A camera's measurement in one frame, and its pose.

    Args:
        depth: z-depth, metres, gaps inside surfaces closed; 0 means no measurement.
        directions_camera: `ray_directions` of the camera.
        rgb: the image, to find occluders without depth (`foreign`); needs a surface with colours.
    """

    depth: Float32[ndarray, "h w"]
    directions_camera: Float32[ndarray, "h w 3"]
    K: Float[ndarray, "3 3"]
    world_from_camera: Float[ndarray, "4 4"]
    rgb: UInt8[ndarray, "h w 3"] | None = None


def visible_instances(
    surface: LabelledSurface,
    frame: MeasuredFrame,
    tolerance: tuple[float, float] = MASK_TOLERANCE,
    occluder: Bool[ndarray, "h w"] | None = None,
    completion: Completion | None = None,
) -> VisibleFrame:
    """The instance visible at each pixel.

    Rays are cast at the whole mesh, so that objects, table and walls hide each other, but only for pixels near an
    object's projection; all others are background.

    Args:
        tolerance: (a, b): measurement and mesh agree within a + b z metres.
        occluder: pixels that show something fixed to the camera (`fixed_to_camera`).
        completion: what may be solid where the mesh has holes; nothing by default.
    """
    depth = frame.depth
    height, width = depth.shape
    boxes = [
        surface.box(label, frame.K, frame.world_from_camera, height, width)
        for label in range(1, surface.n_instances + 1)
    ]
    region = np.zeros((height, width), bool)
    for box in boxes:
        region[box] = True
    rays = rays_of(frame.directions_camera, frame.world_from_camera)
    rendered = surface.image(rays.through(region), region)
    n_through = _see_through(surface, rays, rendered, depth, region, tolerance)
    decision = decided(rendered.instance, rendered.depth, depth, region, tolerance)
    label, n_pixels = decision.label, decision.n_pixels
    n_pixels["measured_through"] = n_through
    if completion is not None and region.any():
        _complete(decision, completion, rays, rendered, depth, region, tolerance)
    if occluder is not None:
        n_pixels["fixed_to_camera"] = int(np.count_nonzero(label[occluder]))
        label[occluder] = 0
    if frame.rgb is not None and surface.colors is not None:
        hidden = foreign(
            frame.rgb, surface.colors, rendered.i_vertex, decision.agrees, decision.in_front, depth <= 0, region
        )
        hidden &= label > 0
        n_pixels["hidden_by_colour"] = int(np.count_nonzero(hidden))
        label[hidden] = 0
    fraction = _visible_fraction(surface, rays, boxes, rendered.instance, label)
    return VisibleFrame(label, decision.measured, fraction, n_pixels)


def _visible_fraction(
    surface: LabelledSurface,
    rays: Rays,
    boxes: list[tuple[slice, slice]],
    ray_label: UInt8[ndarray, "h w"],
    label: UInt8[ndarray, "h w"],
) -> Float32[ndarray, "k"]:
    """Visible pixels of each instance over those of its amodal mask, estimated from a sample of the rays around it."""
    visible, hit = _n_of_label(label), _n_of_label(ray_label)
    fraction = np.full(surface.n_instances, np.nan, np.float32)
    for instance, (rows, columns) in enumerate(boxes, start=1):
        if rows.start == rows.stop or columns.start == columns.stop:
            continue
        n_others = (rows.stop - rows.start) * (columns.stop - columns.start) - np.count_nonzero(
            ray_label[rows, columns] == instance
        )
        step = max(1, -(-n_others // N_AMODAL_RAYS))
        others = _rays_beside(
            rays.origin, rays.directions[rows, columns], ray_label[rows, columns], instance, step, -(-n_others // step)
        )
        amodal = hit[instance] + surface.share_meeting(instance, others) * n_others
        if amodal > 0:
            fraction[instance - 1] = min(1.0, visible[instance] / amodal)
    return fraction


@compiled
def _n_of_label(labels):  # type: ignore[no-untyped-def]
    """Pixels of each label (256,)."""
    counts = np.zeros(256, np.int64)
    for label in labels.ravel():
        counts[label] += 1
    return counts


@compiled
def _rays_beside(origin, directions, ray_label, instance, step, n_rays):  # type: ignore[no-untyped-def]
    """Every `step`-th of the rays that do not meet an instance first, row by row (n_rays, 6)."""
    rays, i_other, i = np.empty((n_rays, 6), np.float32), 0, 0
    for v in range(ray_label.shape[0]):
        for u in range(ray_label.shape[1]):
            if ray_label[v, u] == instance:
                continue
            if i_other == i * step:
                for axis in range(3):
                    rays[i, axis], rays[i, 3 + axis] = origin[axis], directions[v, u, axis]
                i += 1
            i_other += 1
    return rays


def _see_through(
    surface: LabelledSurface,
    rays: Rays,
    rendered: LabelledImage,
    depth: Float32[ndarray, "h w"],
    region: Bool[ndarray, "h w"],
    tolerance: tuple[float, float],
) -> int:
    """Replace hits by a later surface where the measurement lies on that; changes `rendered`.

    A fused mesh has flakes in front of thin walls and across concave edges. A measurement behind disproves them.

    Returns:
        Pixels of objects whose label changed.
    """
    allowed = np.float32(tolerance[0]) + np.float32(tolerance[1]) * depth
    passed = np.flatnonzero(region & (depth > rendered.depth + allowed))
    if len(passed) == 0:
        return 0
    # From both sides, because the table just behind an object that was removed must win over the object's back.
    here, reach, through = depth.reshape(-1)[passed], allowed.reshape(-1)[passed], rays.at(passed)
    nearest, label = np.full(len(here), np.inf, np.float32), np.zeros(len(here), np.uint8)
    for side in (-1, 1):
        towards = through.copy()
        towards[:, :3] += (here + side * reach)[:, None] * towards[:, 3:]
        towards[:, 3:] *= -side
        further, candidate = surface.cast(towards)
        off = side * (reach - further)
        better = (further <= 2 * reach) & (np.abs(off) < np.abs(nearest))
        nearest[better], label[better] = off[better], candidate[better]
    on_mesh = np.isfinite(nearest)
    where, label = passed[on_mesh], label[on_mesh]
    ray_label = rendered.instance.reshape(-1)
    n_changed = int(np.count_nonzero((ray_label[where] > 0) & (ray_label[where] != label)))
    rendered.depth.reshape(-1)[where] = (here + nearest)[on_mesh]
    ray_label[where] = label
    return n_changed


def _complete(
    decision: Decision,
    completion: Completion,
    rays: Rays,
    rendered: LabelledImage,
    depth: Float32[ndarray, "h w"],
    region: Bool[ndarray, "h w"],
    tolerance: tuple[float, float],
) -> None:
    """Assign pixels where the mesh has a hole to the object that may be solid there; changes `decision`.

    A measurement in front of the mesh belongs to the object whose hull holds it; without measurement, the ray has to
    meet the hull before the mesh.
    """
    measured, ray_label = depth > 0, rendered.instance.reshape(-1)
    silent = np.flatnonzero(region & ~measured & (rendered.instance == 0))
    odd = np.flatnonzero(region & measured & ~decision.agrees & (depth < rendered.depth))
    through = rays.at(odd)
    holder = completion.holds(through[:, :3] + through[:, 3:] * depth.reshape(-1)[odd][:, None])
    # In front of another object's surface there is no hole of this one.
    holder[(ray_label[odd] > 0) & (ray_label[odd] != holder)] = 0
    decision.label.reshape(-1)[odd] = holder
    decision.in_front.reshape(-1)[odd] &= holder == 0
    decision.n_pixels["measured_where_the_mesh_has_a_hole"] = int(np.count_nonzero(holder))
    z, label = completion.hit(rays.at(silent))
    with np.errstate(invalid="ignore"):
        label[~(z < rendered.depth.reshape(-1)[silent] - tolerance[0] - tolerance[1] * z)] = 0
    decision.label.reshape(-1)[silent] = label
    decision.measured.reshape(-1)[silent] = label == 0
    decision.n_pixels["not_measured_and_filled"] = int(np.count_nonzero(label))
