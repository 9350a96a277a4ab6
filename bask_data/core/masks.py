"""Visible masks: which object each pixel shows, decided by the ray to the mesh and the measured depth together."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
import open3d as o3d
from jaxtyping import Bool, Float, Float32, Int, Int32, UInt8
from numpy import ndarray
from scipy.optimize import nnls
from scipy.spatial import ConvexHull, QhullError

from bask_data.core.compiled import compiled
from bask_data.core.completion import Completion
from bask_data.core.depth import SIGMA_FROM_MAD
from bask_data.core.geometry import invert_rigid, pixel_grid, project, transform, unproject
from bask_data.core.rays import ray_scene

MAX_INSTANCES = 255
"""Label images are 8-bit."""

TOLERANCE = (0.01, 0.02)
"""Measurement and mesh agree within a + b z metres. On analytic scenes with 1 to 5 mm of noise masks are the same for
anything from 5 mm to 4 cm; sparse sensors and their poses need two to three centimetres at half a metre."""

N_SIGMA = 4.0
"""Standard deviations of the sensor's noise that measurement and mesh may be apart."""

MESH_ERROR = 3.5
"""Voxels by which thin walls and sharp edges of a fused mesh are off."""

MOST_TOLERANCE = (0.04, 0.06)
"""Limits of (a, b): beyond them a hand before an object would count as its surface, whatever the sensor's noise."""

N_RESIDUALS_LEAST = 400
"""Fewer residuals say nothing of a sensor's noise."""

EDGE_REACH = 2
"""Pixels by which the silhouette of the mesh may miss that of the object; about a voxel."""

VOTE_RADII = (2, 4)
"""Pixels around one without measurement in which measured ones speak for it; the wider window where the first is
silent. Farther off, a shiny face that is wrongly measured in one place would lose all that was not measured."""

MARGIN = 1 + EDGE_REACH
"""Pixels cast around an object's outline, so that the edges can be set right from both sides."""

N_CONFIRMING_RAYS = 40_000
"""Rays cast per frame in the search for what is fixed to the camera; every pixel would cost as much as the masks."""

N_AMODAL_RAYS = 10_000
"""Rays cast to find how much of an instance is hidden; more than that would make a share no more telling."""

N_COLOURS = 5000
"""Pixels whose colour is held against the mesh's to learn a frame's exposure."""

N_COLOURS_LEAST = 200
"""Fewer agreeing pixels than that say nothing of it."""

COLOUR_OFF = 4.0
"""Times the usual difference from the mesh's colour at which a pixel shows something else."""

LEAST_COLOUR_OFF = 60.0
"""Grey levels; shadows and highlights of a moving camera change a surface by less."""

NO_VERTEX = np.int32(-1)

MIXED = np.uint16(1000)
"""Stands for the label of a triangle whose corners differ."""

STEADY = 0.35
"""Colour at a pixel that varies over the frames by less than this share of what the scene's pixels do is taken for
fixed."""

LEAST_CHANGE = 8.0
"""Grey levels; when the scene's own pixels vary by less, the camera hardly moved and nothing can be told."""


class Surface:
    """A mesh with an instance at every vertex, ready for rays.

    Args:
        vertex_instance: 0 is background, 1..`n_instances` are objects.

    Raises:
        ValueError: there is no triangle, or a label is out of range.
    """

    def __init__(
        self,
        vertices: Float32[ndarray, "n 3"],
        triangles: Int32[ndarray, "m 3"],
        vertex_instance: Int32[ndarray, "n"],
        n_instances: int,
        colors: UInt8[ndarray, "n 3"] | None = None,
    ) -> None:
        if len(triangles) == 0:
            raise ValueError("triangles: expected at least one, got none")
        if n_instances > MAX_INSTANCES:
            raise ValueError(f"n_instances: expected at most {MAX_INSTANCES}, got {n_instances}")
        if vertex_instance.min() < 0 or vertex_instance.max() > n_instances:
            raise ValueError(
                f"vertex_instance: expected 0..{n_instances}, got {vertex_instance.min()}..{vertex_instance.max()}"
            )
        self.n_instances = n_instances
        self.colors = colors
        self._triangles = triangles
        self._scene = ray_scene(vertices, triangles)
        self._corner_label = vertex_instance[triangles].astype(np.uint8)
        majority = _majority(self._corner_label)
        uniform = (self._corner_label == self._corner_label[:, :1]).all(axis=1)
        self._triangle_label = np.append(np.where(uniform, majority.astype(np.uint16), MIXED), np.uint16(0))
        self._outlines: list[Float[ndarray, "_ 3"]] = []
        self._alone: list[o3d.t.geometry.RaycastingScene | None] = []
        for label in range(1, n_instances + 1):
            own = triangles[majority == label]
            # Rays hit every triangle that has a corner of the instance, so its outline has to hold those too.
            near = triangles[(self._corner_label == label).any(axis=1)]
            self._outlines.append(_hull(vertices[np.unique(near)]))
            self._alone.append(ray_scene(vertices, own) if len(own) else None)

    def cast(self, rays: Float32[ndarray, "n 6"]) -> tuple[Float32[ndarray, "n"], UInt8[ndarray, "n"]]:
        """Ray parameter of the first hit (infinity: none), and the instance there, of rays (origin, direction).

        A triangle that two instances share is divided between them: the hit takes the label of the nearest corner.
        """
        hits = self._scene.cast_rays(o3d.core.Tensor.from_numpy(rays))
        return hits["t_hit"].numpy(), self._label_of(hits)

    def cast_to_vertices(
        self, rays: Float32[ndarray, "n 6"]
    ) -> tuple[Float32[ndarray, "n"], UInt8[ndarray, "n"], Int32[ndarray, "n"]]:
        """As `cast`, and a vertex of the triangle hit; `NO_VERTEX` for none."""
        hits = self._scene.cast_rays(o3d.core.Tensor.from_numpy(rays))
        i_triangle = hits["primitive_ids"].numpy()
        some = i_triangle < len(self._triangles)
        i_vertex = np.where(some, self._triangles[np.where(some, i_triangle, 0), 0], NO_VERTEX)
        return hits["t_hit"].numpy(), self._label_of(hits), i_vertex

    def _label_of(self, hits: dict[str, o3d.core.Tensor]) -> UInt8[ndarray, "n"]:
        # What misses has the largest index there is; it becomes the one after the last triangle, which is background.
        i_triangle = np.minimum(hits["primitive_ids"].numpy(), np.uint32(len(self._corner_label)))
        label = self._triangle_label[i_triangle]
        mixed = np.flatnonzero(label == MIXED)
        corners = self._corner_label[i_triangle[mixed]]
        second_third = hits["primitive_uvs"].numpy()[mixed]
        weights = np.column_stack([1 - second_third.sum(axis=1), second_third])
        label[mixed] = corners[np.arange(len(mixed)), weights.argmax(axis=1)]
        return label.astype(np.uint8)

    def n_meeting(self, instance: int, rays: Float32[ndarray, "n 6"]) -> float:
        """Number of rays that would hit an instance if there were nothing else; of very many, estimated by some."""
        alone = self._alone[instance - 1]
        step = max(1, -(-len(rays) // N_AMODAL_RAYS))
        if alone is None or len(rays) == 0:
            return 0.0
        some = np.ascontiguousarray(rays[::step])
        return float(alone.test_occlusions(o3d.core.Tensor.from_numpy(some)).numpy().mean() * len(rays))

    def box(
        self,
        instance: int,
        K: Float[ndarray, "3 3"],
        world_from_camera: Float[ndarray, "4 4"],
        height: int,
        width: int,
    ) -> tuple[slice, slice]:
        """Rows and columns that hold the image of an instance with a margin; empty when it is out of view."""
        points = transform(invert_rigid(world_from_camera), self._outlines[instance - 1])
        if len(points) == 0 or (points[:, 2] <= 0).all():
            return slice(0, 0), slice(0, 0)
        if (points[:, 2] <= 1e-3).any():  # What reaches behind the camera has no bounded image.
            return slice(0, height), slice(0, width)
        uv, _ = project(points, K)
        (left, top), (right, bottom) = np.floor(uv.min(axis=0)) - MARGIN, np.ceil(uv.max(axis=0)) + MARGIN + 1
        rows = slice(int(np.clip(top, 0, height)), int(np.clip(bottom, 0, height)))
        columns = slice(int(np.clip(left, 0, width)), int(np.clip(right, 0, width)))
        return rows, columns


def world_rays(
    directions_camera: Float32[ndarray, "h w 3"], world_from_camera: Float[ndarray, "4 4"]
) -> Float32[ndarray, "h w 6"]:
    """Origin and direction of the ray through each pixel, world frame."""
    rays = np.empty((*directions_camera.shape[:2], 6), np.float32)
    rays[..., :3] = world_from_camera[:3, 3]
    # A matrix product with three columns takes NumPy ten times as long.
    rays[..., 3:] = cv2.transform(directions_camera, world_from_camera[:3, :3].astype(np.float32))
    return rays


def _majority(corner_label: UInt8[ndarray, "m 3"]) -> UInt8[ndarray, "m"]:
    """The label of two corners or more; the first corner's when all differ."""
    first, second, third = corner_label.T
    return np.where(second == third, second, first)


def _hull(points: Float32[ndarray, "n 3"]) -> Float[ndarray, "_ 3"]:
    """Points whose projections bound those of all of them."""
    points = points.astype(np.float64)
    try:
        return points[ConvexHull(points).vertices]
    except (QhullError, ValueError):  # Too few points, or all in a plane.
        return points


def ray_directions(K: Float[ndarray, "3 3"], height: int, width: int) -> Float32[ndarray, "h w 3"]:
    """Directions in the camera frame through the pixel centres, with z = 1, so that a hit's ray parameter is its
    z-depth.

    Open3D's own pinhole rays go through pixel corners; with those, masks lose 4 % IoU to half a pixel.
    """
    grid = pixel_grid(height, width)
    return unproject(grid, np.ones((height, width)), K).astype(np.float32)


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
    surface: Surface,
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
    surface: Surface,
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


@dataclass(frozen=True)
class Decision:
    """What ray and measurement say together.

    Args:
        measured: False at pixels whose ray meets an object and which have no measurement.
        agrees: the measurement lies on the mesh, at this pixel or within `EDGE_REACH`.
        in_front: the measurement lies before the mesh.
    """

    label: UInt8[ndarray, "h w"]
    measured: Bool[ndarray, "h w"]
    agrees: Bool[ndarray, "h w"]
    in_front: Bool[ndarray, "h w"]
    n_pixels: dict[str, int]


def decided(
    ray_label: UInt8[ndarray, "h w"],
    rendered: Float32[ndarray, "h w"],
    depth: Float32[ndarray, "h w"],
    region: Bool[ndarray, "h w"],
    tolerance: tuple[float, float],
) -> Decision:
    """Label of each pixel from the ray's and from the measurement, and how many objects' pixels were decided by which.

    - Both agree: the ray's label.
    - They do not, but the measurement agrees with the mesh within `EDGE_REACH` pixels: the label from there. So edges
      lie where they were measured, not where the voxels put them, and thin parts keep their width.
    - Measured in front of the mesh: something the mesh does not know is in the way (a hand, a gripper). Measured
      behind: the mesh is wrong there, or the object was moved. Neither shows the object: 0.
    - Not measured: the ray's label, unless the nearest measurements around speak mostly of something in front or
      behind.

    Args:
        ray_label: instance the ray meets first.
        rendered: z-depth of that hit, metres; infinity for none.
        region: pixels a ray was cast for. Outside nothing is known, and nothing changed.
    """
    measured = (depth > 0) & region
    allowed = np.float32(tolerance[0]) + np.float32(tolerance[1]) * depth
    with np.errstate(invalid="ignore"):
        agrees = measured & (np.abs(depth - rendered) <= allowed)
    label = ray_label.copy()
    v, u = np.nonzero(measured & ~agrees)
    doubtful = (v, u)
    corrected, found = _label_nearby(ray_label, rendered, depth, allowed, doubtful)
    label[doubtful] = corrected
    agrees[doubtful] = found
    # A measurement where the mesh has a hole speaks for nothing: the background beside an object is no obstacle
    # before it.
    contradicts = measured & ~agrees & np.isfinite(rendered)
    silent = region & (depth <= 0) & (ray_label > 0)
    hidden = silent & _outvoted(agrees, contradicts, silent)
    label[hidden] = 0
    on_object = ray_label > 0
    in_front = contradicts & (depth < rendered)
    n_pixels = {
        "measured_and_agreeing": int(np.count_nonzero(agrees & on_object)),
        "measured_in_front": int(np.count_nonzero(in_front & on_object)),
        "measured_behind": int(np.count_nonzero(contradicts & ~in_front & on_object)),
        "not_measured_and_kept": int(np.count_nonzero(silent & ~hidden)),
        "not_measured_and_hidden": int(np.count_nonzero(hidden)),
    }
    return Decision(label, ~silent, agrees, in_front, n_pixels)


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


def foreign(
    rgb: UInt8[ndarray, "h w 3"],
    colors: UInt8[ndarray, "n 3"],
    i_vertex: Int32[ndarray, "h w"],
    agrees: Bool[ndarray, "h w"],
    in_front: Bool[ndarray, "h w"],
    silent: Bool[ndarray, "h w"],
    region: Bool[ndarray, "h w"],
) -> Bool[ndarray, "h w"]:
    """Pixels without depth that show something the mesh does not: a finger too near or too dark for the sensor.

    Their colour differs from the mesh's by far more than that of the pixels whose depth lies on the mesh does, after
    the frame's exposure was fitted to the mesh's; and they hang together with a place where such a thing comes
    from: the edge of the image or of the region, or a measurement in front of the mesh. A highlight on an object is
    an island, and stays.

    Args:
        colors: of the mesh's vertices.
        i_vertex: vertex nearest to each ray's hit; `NO_VERTEX` for none.
        region: pixels a ray was cast for.
    """
    nothing = np.zeros(silent.shape, bool)
    if not (silent & (i_vertex != NO_VERTEX)).any():
        return nothing
    v, u = np.nonzero(agrees & (i_vertex != NO_VERTEX))
    if len(v) < N_COLOURS_LEAST:
        return nothing
    step = max(1, len(v) // N_COLOURS)
    v, u = v[::step], u[::step]
    expected, seen = colors[i_vertex[v, u]].astype(np.float32), rgb[v, u].astype(np.float32)
    gain = np.median(seen, axis=0) / np.maximum(np.median(expected, axis=0), 1)
    usual = float(np.median(np.abs(seen - gain * expected).max(axis=1)))
    off = _colour_off(rgb, colors, i_vertex, silent & region, gain.astype(np.float32))
    # One pixel says little: texture is a voxel wide on the mesh. A window's mean does.
    n_around = cv2.boxFilter((off > 0).astype(np.float32), -1, (5, 5), normalize=False)
    mean_off = cv2.boxFilter(off, -1, (5, 5), normalize=False) / np.maximum(n_around, 1)
    strange = silent & region & (mean_off > max(COLOUR_OFF * usual, LEAST_COLOUR_OFF))
    if not strange.any():
        return nothing
    _, component = cv2.connectedComponents((strange | in_front).astype(np.uint8), connectivity=8)
    # What lies outside the region was not looked at, so a thing may come from there.
    inner = cv2.erode(region.astype(np.uint8), np.ones((3, 3), np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=0)
    source = region & (inner == 0)
    # Single pixels measured in front are noise at edges, found around every object.
    source |= cv2.morphologyEx(in_front.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)) > 0
    comes_from_outside = np.isin(component, np.unique(component[source & (component > 0)]))
    return strange & comes_from_outside & (component > 0)


@compiled
def _colour_off(rgb, colors, i_vertex, asked, gain):  # type: ignore[no-untyped-def]
    """(h, w) float32: largest difference of a channel between image and mesh, grey levels; 0 where not asked, or where
    the ray meets nothing. NumPy takes six times as long to gather the colours."""
    off = np.zeros(asked.shape, np.float32)
    for v in range(asked.shape[0]):
        for u in range(asked.shape[1]):
            i = i_vertex[v, u]
            if asked[v, u] and i != NO_VERTEX:
                for channel in range(3):
                    off[v, u] = max(off[v, u], abs(rgb[v, u, channel] - gain[channel] * colors[i, channel]))
    return off


def _label_nearby(
    ray_label: UInt8[ndarray, "h w"],
    rendered: Float32[ndarray, "h w"],
    depth: Float32[ndarray, "h w"],
    allowed: Float32[ndarray, "h w"],
    doubtful: tuple[Int[ndarray, "n"], Int[ndarray, "n"]],
) -> tuple[UInt8[ndarray, "n"], Bool[ndarray, "n"]]:
    """Label of the nearest pixel around whose rendered depth agrees with the one measured here; (0, False) where none
    does."""
    height, width = depth.shape
    v, u = doubtful
    here, slack = depth[v, u], allowed[v, u]
    corrected, found = np.zeros(len(v), np.uint8), np.zeros(len(v), bool)
    steps = [(dv, du) for dv in range(-EDGE_REACH, EDGE_REACH + 1) for du in range(-EDGE_REACH, EDGE_REACH + 1)]
    for dv, du in sorted(steps, key=lambda step: step[0] ** 2 + step[1] ** 2)[1:]:
        v_near, u_near = np.clip(v + dv, 0, height - 1), np.clip(u + du, 0, width - 1)
        match = ~found & (np.abs(rendered[v_near, u_near] - here) <= slack)
        corrected[match] = ray_label[v_near[match], u_near[match]]
        found |= match
    return corrected, found


def _outvoted(
    agrees: Bool[ndarray, "h w"], contradicts: Bool[ndarray, "h w"], silent: Bool[ndarray, "h w"]
) -> Bool[ndarray, "h w"]:
    """Silent pixels among measured ones most of which contradict the mesh."""
    outvoted = np.zeros(agrees.shape, bool)
    if not contradicts.any():
        return outvoted
    balance = agrees.astype(np.float32) - contradicts
    spoken = (agrees | contradicts).astype(np.float32)
    undecided = silent.copy()
    for radius in VOTE_RADII:
        window = (2 * radius + 1, 2 * radius + 1)
        heard = undecided & (cv2.boxFilter(spoken, -1, window, normalize=False, borderType=cv2.BORDER_CONSTANT) > 0.5)
        votes = cv2.boxFilter(balance, -1, window, normalize=False, borderType=cv2.BORDER_CONSTANT)
        outvoted |= heard & (votes < -0.5)
        undecided &= ~heard
    return outvoted


def residuals(
    surface: Surface,
    depth: Float32[ndarray, "h w"],
    directions_camera: Float32[ndarray, "h w 3"],
    world_from_camera: Float[ndarray, "4 4"],
    n_rays: int = 4000,
) -> Float32[ndarray, "n 2"]:
    """Measured depth and its difference from the mesh, metres, of about `n_rays` pixels whose ray meets the mesh."""
    where = np.flatnonzero(depth)
    where = where[:: max(1, len(where) // n_rays)]
    if len(where) == 0:
        return np.zeros((0, 2), np.float32)
    rendered, _ = surface.cast(world_rays(directions_camera, world_from_camera).reshape(-1, 6)[where])
    met = np.isfinite(rendered)
    here = depth.reshape(-1)[where][met]
    return np.stack([here, here - rendered[met]], axis=1)


def noise(samples: Float32[ndarray, "n 2"], n_bins: int = 8) -> tuple[float, float] | None:
    """(a, b) of the sensor's noise: its standard deviation is a + b z metres; None when there is too little to tell.

    Taken from the median deviation of the residuals in bins of depth, so that neither hands nor flying pixels nor a
    hole in the mesh count, as long as they are less than half. Errors of the mesh and of the poses are in it too: what
    is asked is how far apart measurement and mesh are where both show one surface.

    Args:
        samples: of `residuals`, all frames of a camera.
    """
    z, off = samples.T.astype(np.float64)
    # A wall seen past a table's edge is no residual; nothing that far off is noise of a sensor worth using.
    near = np.abs(off) <= 0.05 + 0.05 * z
    z, off = z[near], off[near]
    if len(z) < N_RESIDUALS_LEAST:
        return None
    edges = np.quantile(z, np.linspace(0, 1, n_bins + 1))
    i_bin = np.clip(np.searchsorted(edges, z, side="right") - 1, 0, n_bins - 1)
    filled = [i for i in range(n_bins) if np.count_nonzero(i_bin == i) >= N_RESIDUALS_LEAST // n_bins // 2]
    centre = np.array([np.median(z[i_bin == i]) for i in filled])
    # About the median: what mesh and measurement differ by everywhere is an error of the mesh.
    sigma = np.array([SIGMA_FROM_MAD * np.median(np.abs(off[i_bin == i] - np.median(off[i_bin == i]))) for i in filled])
    (a, b), _ = nnls(np.stack([np.ones(len(centre)), centre], axis=1), sigma)
    return float(a), float(b)


def tolerance_of(deviation: tuple[float, float] | None, voxel_size: float) -> tuple[float, float]:
    """(a, b) of the tolerance that goes with a sensor's noise; `TOLERANCE` where that is unknown.

    Args:
        voxel_size: metres; at thin walls the mesh is off by some voxels, however good the sensor.
    """
    if deviation is None:
        return TOLERANCE
    a, b = (N_SIGMA * one for one in deviation)
    return min(max(a, MESH_ERROR * voxel_size), MOST_TOLERANCE[0]), min(b, MOST_TOLERANCE[1])


def confirmed(
    surface: Surface,
    depth: Float32[ndarray, "h w"],
    directions_camera: Float32[ndarray, "h w 3"],
    world_from_camera: Float[ndarray, "4 4"],
    tolerance: tuple[float, float] = TOLERANCE,
) -> Bool[ndarray, "h w"]:
    """Pixels whose measurement lies on the mesh, among an even selection of those that have one."""
    where = np.flatnonzero(depth)
    where = where[:: max(1, len(where) // N_CONFIRMING_RAYS)]
    seen = np.zeros(depth.shape, bool)
    if len(where):
        rendered, _ = surface.cast(world_rays(directions_camera, world_from_camera).reshape(-1, 6)[where])
        here = depth.reshape(-1)[where]
        seen.reshape(-1)[where] = np.abs(rendered - here) <= tolerance[0] + tolerance[1] * here
    return seen


def fixed_to_camera(
    frames: Iterable[tuple[UInt8[ndarray, "h w 3"], Bool[ndarray, "h w"]]], height: int, width: int
) -> Bool[ndarray, "h w"]:
    """Pixels that show something which moves with the camera: a gripper's pads, which often give no depth at all.

    Such a pixel looks the same in every frame while the rest of the image changes, and its depth never lies on the
    reconstruction. Colour alone would take a bare wall for it, depth alone every hole of the sensor.

    Args:
        frames: colour, and the pixels whose depth is `confirmed`, of frames spread over a camera's path.
    """
    total, total_squared = np.zeros((height, width), np.float32), np.zeros((height, width), np.float32)
    n_confirmed = np.zeros((height, width), np.float32)
    n_frames = 0
    for rgb, is_confirmed in frames:
        grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
        total += grey
        total_squared += grey * grey
        n_confirmed += is_confirmed
        n_frames += 1
    nothing = np.zeros((height, width), bool)
    if n_frames < 3 or not n_confirmed.any():
        return nothing
    change = cv2.blur(np.sqrt(np.maximum(total_squared / n_frames - (total / n_frames) ** 2, 0)), (5, 5))
    scene_change = float(np.median(change[n_confirmed > 0]))
    if scene_change < LEAST_CHANGE:
        return nothing
    # Two frames' worth of a stray measurement in the window is no confirmation; a scene's pixel has dozens.
    confirmations = cv2.boxFilter(n_confirmed, -1, (5, 5), normalize=False, borderType=cv2.BORDER_CONSTANT)
    steady = ((change < STEADY * scene_change) & (confirmations <= 2)).astype(np.uint8)
    steady = cv2.morphologyEx(steady, cv2.MORPH_OPEN, np.ones((9, 9), np.uint8))
    # Both windows reach two pixels over the outline, and the opening rounds its corners.
    return cv2.dilate(steady, np.ones((7, 7), np.uint8)) > 0
