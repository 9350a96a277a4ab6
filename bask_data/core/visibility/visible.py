"""Visible masks: which object each pixel shows, decided by the ray to the mesh and the measured depth together."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8
from numpy import ndarray

from bask_data.core.visibility.completion import Completion
from bask_data.core.visibility.decision import Decision, decided
from bask_data.core.visibility.foreign import foreign
from bask_data.core.visibility.labelled import NO_VERTEX, LabelledSurface
from bask_data.core.visibility.sensor import TOLERANCE
from bask_data.core.visibility.surface import world_rays


@dataclass(frozen=True)
class VisibleFrame:
    """One frame's masks.

    Args:
        measured: False where an object was a candidate and no measurement had a say: the ray alone decided, or
            what the pixels around measured, or what the scene looks like.
        visible_fraction: share of each instance's own projection that is visible, in [0, 1]; NaN where it has none.
        n_pixels: pixels by how they were decided.
    """

    instance: UInt8[ndarray, "h w"]
    measured: Bool[ndarray, "h w"]
    visible_fraction: Float32[ndarray, "k"]
    n_pixels: dict[str, int]


def visible_instances(
    surface: LabelledSurface,
    depth: Float32[ndarray, "h w"],
    directions_camera: Float32[ndarray, "h w 3"],
    K: Float[ndarray, "3 3"],
    world_from_camera: Float[ndarray, "4 4"],
    tolerance: tuple[float, float] = TOLERANCE,
    occluder: Bool[ndarray, "h w"] | None = None,
    completion: Completion | None = None,
    rgb: UInt8[ndarray, "h w 3"] | None = None,
) -> VisibleFrame:
    """The instance visible at each pixel.

    The whole mesh is cast, so objects, table and walls hide each other. Only pixels near some object's projection
    need a ray; all others are background.

    Args:
        depth: measured z-depth, metres, gaps inside surfaces closed; 0 means no measurement.
        directions_camera: `ray_directions` of the camera.
        tolerance: (a, b): measurement and mesh agree within a + b z metres.
        occluder: pixels that show something fixed to the camera (`fixed_to_camera`).
        completion: what may be solid where the mesh has holes; nothing by default.
        rgb: the image, to find what hides objects and gives no depth (`foreign`); needs a surface with colours.
    """
    height, width = depth.shape
    boxes = [surface.box(label, K, world_from_camera, height, width) for label in range(1, surface.n_instances + 1)]
    near_object = np.zeros((height, width), bool)
    for box in boxes:
        near_object[box] = True
    rendered = np.full((height, width), np.inf, np.float32)
    ray_label = np.zeros((height, width), np.uint8)
    i_vertex = np.full((height, width), NO_VERTEX, np.int32)
    rays = np.zeros((0, 0, 6), np.float32)
    if near_object.any():
        rays = world_rays(directions_camera, world_from_camera)
        # Picking pixels out and putting them back takes a tenth of the cast, and objects often fill the image.
        chosen = rays.reshape(-1, 6) if near_object.all() else rays[near_object]
        if rgb is not None and surface.colors is not None:
            rendered[near_object], ray_label[near_object], i_vertex[near_object] = surface.cast_to_vertices(chosen)
        else:
            rendered[near_object], ray_label[near_object] = surface.cast(chosen)
    n_through = 0
    if near_object.any():
        n_through = _see_through(surface, rays, rendered, ray_label, depth, near_object, tolerance)
    decision = decided(ray_label, rendered, depth, near_object, tolerance)
    label, measured, n_pixels = decision.label, decision.measured, decision.n_pixels
    n_pixels["measured_through"] = n_through
    if completion is not None and near_object.any():
        _complete(decision, completion, rays, ray_label, rendered, depth, near_object, tolerance)
    if occluder is not None:
        n_pixels["fixed_to_camera"] = int(np.count_nonzero(label[occluder]))
        label = np.where(occluder, np.uint8(0), label)
    if rgb is not None and surface.colors is not None:
        hidden = foreign(rgb, surface.colors, i_vertex, decision.agrees, decision.in_front, depth <= 0, near_object)
        hidden &= label > 0
        n_pixels["hidden_by_colour"] = int(np.count_nonzero(hidden))
        label[hidden] = 0
    visible = np.bincount(label.reshape(-1), minlength=surface.n_instances + 1)[1:]
    hit = np.bincount(ray_label.reshape(-1), minlength=surface.n_instances + 1)[1:]
    fraction = np.full(surface.n_instances, np.nan, np.float32)
    for i_instance, box in enumerate(boxes):
        if box[0].start == box[0].stop or box[1].start == box[1].stop:
            continue
        others = rays[box][ray_label[box] != i_instance + 1]
        amodal = hit[i_instance] + surface.n_meeting(i_instance + 1, others)
        if amodal > 0:
            fraction[i_instance] = min(1.0, visible[i_instance] / amodal)
    return VisibleFrame(label, measured, fraction, n_pixels)


def _see_through(
    surface: LabelledSurface,
    rays: Float32[ndarray, "h w 6"],
    rendered: Float32[ndarray, "h w"],
    ray_label: UInt8[ndarray, "h w"],
    depth: Float32[ndarray, "h w"],
    region: Bool[ndarray, "h w"],
    tolerance: tuple[float, float],
) -> int:
    """Where the measurement passed the first surface and lies on a later one, that one is seen; changes `rendered` and
    `ray_label`, and tells how many objects' pixels went to another label by that.

    A fused mesh has flakes before thin walls and across concave edges. A measurement behind them proves them wrong.
    """
    allowed = np.float32(tolerance[0]) + np.float32(tolerance[1]) * depth
    passed = np.nonzero(region & (depth > rendered + allowed))
    if len(passed[0]) == 0:
        return 0
    # From both sides, because the table just behind an object that was taken away must win over the object's back.
    here, reach = depth[passed], allowed[passed]
    nearest, label = np.full(len(here), np.inf, np.float32), np.zeros(len(here), np.uint8)
    for side in (-1, 1):
        towards = rays[passed].copy()
        towards[:, :3] += (here + side * reach)[:, None] * towards[:, 3:]
        towards[:, 3:] *= -side
        further, candidate = surface.cast(towards)
        off = side * (reach - further)
        better = (further <= 2 * reach) & (np.abs(off) < np.abs(nearest))
        nearest[better], label[better] = off[better], candidate[better]
    on_mesh = np.isfinite(nearest)
    where = passed[0][on_mesh], passed[1][on_mesh]
    n_changed = int(np.count_nonzero((ray_label[where] > 0) & (ray_label[where] != label[on_mesh])))
    rendered[where] = (here + nearest)[on_mesh]
    ray_label[where] = label[on_mesh]
    return n_changed


def _complete(
    decision: Decision,
    completion: Completion,
    rays: Float32[ndarray, "h w 6"],
    ray_label: UInt8[ndarray, "h w"],
    rendered: Float32[ndarray, "h w"],
    depth: Float32[ndarray, "h w"],
    region: Bool[ndarray, "h w"],
    tolerance: tuple[float, float],
) -> None:
    """Give pixels at which the mesh has a hole to the object that may be solid there; changes `decision`.

    A measurement before the mesh belongs to the object whose hull holds it; without one, the ray has to meet the
    hull before the mesh.
    """
    no_object = region & (ray_label == 0)
    odd = np.nonzero(region & (depth > 0) & ~decision.agrees & (depth < rendered))
    points = rays[odd][:, :3] + rays[odd][:, 3:] * depth[odd][:, None]
    holder = completion.holds(points)
    # Before another object's surface it is no hole of this one.
    holder[(ray_label[odd] > 0) & (ray_label[odd] != holder)] = 0
    decision.label[odd] = holder
    decision.in_front[odd] &= holder == 0
    decision.n_pixels["measured_where_the_mesh_has_a_hole"] = int(np.count_nonzero(holder))
    silent = np.nonzero(no_object & (depth <= 0))
    z, label = completion.hit(rays[silent])
    with np.errstate(invalid="ignore"):
        label[~(z < rendered[silent] - tolerance[0] - tolerance[1] * z)] = 0
    decision.label[silent] = label
    decision.measured[silent] = label == 0
    decision.n_pixels["not_measured_and_filled"] = int(np.count_nonzero(label))
