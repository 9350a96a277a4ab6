"""Visible masks: which object each pixel shows, decided by the ray to the mesh and the measured depth together."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
import open3d as o3d
from jaxtyping import Bool, Float, Float32, Int, Int32, UInt8
from numpy import ndarray
from scipy.spatial import ConvexHull, QhullError

from bask_data.core.geometry import invert_rigid, pixel_grid, project, transform, unproject

MAX_INSTANCES = 255
"""Label images are 8-bit."""

TOLERANCE = (0.01, 0.02)
"""Measurement and mesh agree within a + b z metres. On analytic scenes with 1 to 5 mm of noise masks are the same for
anything from 5 mm to 4 cm; sparse sensors and their poses need two to three centimetres at half a metre."""

EDGE_REACH = 2
"""Pixels by which the silhouette of the mesh may miss that of the object; about a voxel."""

VOTE_RADII = (2, 8)
"""Pixels around one without measurement in which measured ones speak for it; the wider window where the first is
silent."""

MARGIN = 1 + EDGE_REACH
"""Pixels cast around an object's outline, so that the edges can be set right from both sides."""

N_CONFIRMING_RAYS = 40_000
"""Rays cast per frame in the search for what is fixed to the camera; every pixel would cost as much as the masks."""

N_AMODAL_RAYS = 10_000
"""Rays cast to find how much of an instance is hidden; more than that would make a share no more telling."""

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
        self._scene = _scene(vertices, triangles)
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
            self._alone.append(_scene(vertices, own) if len(own) else None)

    def cast(self, rays: Float32[ndarray, "n 6"]) -> tuple[Float32[ndarray, "n"], UInt8[ndarray, "n"]]:
        """Ray parameter of the first hit (infinity: none), and the instance there, of rays (origin, direction).

        A triangle that two instances share is divided between them: the hit takes the label of the nearest corner.
        """
        hits = self._scene.cast_rays(o3d.core.Tensor.from_numpy(rays))
        # What misses has the largest index there is; it becomes the one after the last triangle, which is background.
        i_triangle = np.minimum(hits["primitive_ids"].numpy(), np.uint32(len(self._corner_label)))
        label = self._triangle_label[i_triangle]
        mixed = np.flatnonzero(label == MIXED)
        corners = self._corner_label[i_triangle[mixed]]
        second_third = hits["primitive_uvs"].numpy()[mixed]
        weights = np.column_stack([1 - second_third.sum(axis=1), second_third])
        label[mixed] = corners[np.arange(len(mixed)), weights.argmax(axis=1)]
        return hits["t_hit"].numpy(), label.astype(np.uint8)

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


def _scene(vertices: Float32[ndarray, "n 3"], triangles: Int32[ndarray, "m 3"]) -> o3d.t.geometry.RaycastingScene:
    scene = o3d.t.geometry.RaycastingScene()
    from_numpy = o3d.core.Tensor.from_numpy
    scene.add_triangles(
        from_numpy(np.ascontiguousarray(vertices)), from_numpy(np.ascontiguousarray(triangles, dtype=np.uint32))
    )
    return scene


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
        visible_fraction: share of each instance's own projection that is visible, in [0, 1]; NaN where it has none.
        n_pixels: pixels by how they were decided.
    """

    instance: UInt8[ndarray, "h w"]
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
) -> VisibleFrame:
    """The instance visible at each pixel.

    The whole mesh is cast, so objects, table and walls hide each other. Only pixels near some object's projection
    need a
    ray; all others are background.

    Args:
        depth: measured z-depth, metres, gaps inside surfaces closed; 0 means no measurement.
        directions_camera: `ray_directions` of the camera.
        tolerance: (a, b): measurement and mesh agree within a + b z metres.
        occluder: pixels that show something fixed to the camera (`fixed_to_camera`).
    """
    height, width = depth.shape
    boxes = [surface.box(label, K, world_from_camera, height, width) for label in range(1, surface.n_instances + 1)]
    near_object = np.zeros((height, width), bool)
    for box in boxes:
        near_object[box] = True
    rendered = np.full((height, width), np.inf, np.float32)
    ray_label = np.zeros((height, width), np.uint8)
    rays = np.zeros((0, 0, 6), np.float32)
    if near_object.any():
        rays = world_rays(directions_camera, world_from_camera)
        rendered[near_object], ray_label[near_object] = surface.cast(rays[near_object])
    label, n_pixels = decided(ray_label, rendered, depth, near_object, tolerance)
    if occluder is not None:
        n_pixels["fixed_to_camera"] = int(np.count_nonzero(label[occluder]))
        label = np.where(occluder, np.uint8(0), label)
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
    return VisibleFrame(label, fraction, n_pixels)


def decided(
    ray_label: UInt8[ndarray, "h w"],
    rendered: Float32[ndarray, "h w"],
    depth: Float32[ndarray, "h w"],
    region: Bool[ndarray, "h w"],
    tolerance: tuple[float, float],
) -> tuple[UInt8[ndarray, "h w"], dict[str, int]]:
    """Label of each pixel from the ray's and from the measurement, and how many objects' pixels were decided by which.

    - Both agree: the ray's label.
    - They do not, but the measurement agrees with the mesh within `EDGE_REACH` pixels: the label from there. So edges
    lie
      where they were measured, not where the voxels put them, and thin parts keep their width.
    - Measured in front of the mesh: something the mesh does not know is in the way (a hand, a gripper). Measured
    behind:
      the mesh is wrong there, or the object was moved. Neither shows the object: 0.
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
    return label, {
        "measured_and_agreeing": int(np.count_nonzero(agrees & on_object)),
        "measured_in_front": int(np.count_nonzero(in_front & on_object)),
        "measured_behind": int(np.count_nonzero(contradicts & ~in_front & on_object)),
        "not_measured_and_kept": int(np.count_nonzero(silent & ~hidden)),
        "not_measured_and_hidden": int(np.count_nonzero(hidden)),
    }


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
