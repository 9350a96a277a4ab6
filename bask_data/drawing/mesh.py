"""Shaded views of a mesh by ray casting: no window, no OpenGL, so that a report can be made on any machine."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from bask_data.core.geometry import invert_rigid, pixel_grid, project, transform, unproject
from bask_data.drawing.colours import Colour

BACKGROUND = (44, 48, 56)
"""Colour where no surface is hit; legible on light and dark pages."""
_MOST_LAYERS = 6
"""Back faces that a ray passes through before it counts as a miss."""


@dataclass(frozen=True)
class Viewpoint:
    """A camera to render from."""

    K: np.ndarray
    world_from_camera: np.ndarray
    height: int
    width: int


class MeshScene:
    """A mesh prepared for rendering from several viewpoints."""

    def __init__(self, vertices: np.ndarray, triangles: np.ndarray) -> None:
        import open3d as o3d

        self._core: Any = o3d.core
        self._triangles = triangles
        mesh = o3d.t.geometry.TriangleMesh()
        mesh.vertex.positions = self._core.Tensor(np.ascontiguousarray(vertices, np.float32))
        mesh.triangle.indices = self._core.Tensor(np.ascontiguousarray(triangles, np.int32))
        mesh.compute_vertex_normals()
        self._normals = mesh.vertex.normals.numpy()
        self._scene = o3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(mesh)

    def render(self, colours: np.ndarray, view: Viewpoint, *, sharp: bool = False, ambient: float = 0.5) -> np.ndarray:
        """The picture (h, w, 3) uint8, lit from the camera.

        Args:
            colours: (n, 3) uint8 of the vertices.
            sharp: colour each point like its nearest vertex instead of interpolating, for labels.
            ambient: share of a colour that does not depend on the angle to the surface, 0 to 1.
        """
        large = Viewpoint(_doubled(view.K), view.world_from_camera, 2 * view.height, 2 * view.width)
        directions = _directions(large)
        triangle, weights = self._cast(large.world_from_camera[:3, 3], directions)
        picture = np.tile(np.array(BACKGROUND, np.float32), (len(directions), 1))
        hit = triangle >= 0
        corners, weights = self._triangles[triangle[hit]], weights[hit]
        normals = np.einsum("nc,ncx->nx", weights, self._normals[corners])
        facing = -np.einsum("nx,nx->n", normals, directions[hit])
        facing /= np.maximum(np.linalg.norm(normals, axis=1) * np.linalg.norm(directions[hit], axis=1), 1e-12)
        if sharp:
            base = colours[corners[np.arange(len(corners)), weights.argmax(axis=1)]].astype(np.float32)
        else:
            base = np.einsum("nc,ncx->nx", weights, colours[corners].astype(np.float32))
        picture[hit] = base * (ambient + (1 - ambient) * np.clip(facing, 0, 1))[:, None]
        image = np.clip(picture, 0, 255).astype(np.uint8).reshape(large.height, large.width, 3)
        return cv2.resize(image, (view.width, view.height), interpolation=cv2.INTER_AREA)

    def _cast(self, origin: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Triangle (-1: none) and barycentric weights of the first *front* face along each ray.

        Rooms are recorded from the inside: from outside, the backs of their walls are skipped, as in a doll's house.
        """
        n = len(directions)
        triangle, weights = np.full(n, -1, np.int64), np.zeros((n, 3), np.float32)
        rays = np.concatenate([np.tile(origin, (n, 1)), directions], axis=1).astype(np.float32)
        pending = np.arange(n)
        for _ in range(_MOST_LAYERS):
            hits = self._scene.cast_rays(self._core.Tensor(rays[pending]))
            distance = hits["t_hit"].numpy()
            front = np.einsum("nx,nx->n", hits["primitive_normals"].numpy(), directions[pending]) < 0
            is_hit = np.isfinite(distance)
            seen, through = is_hit & front, is_hit & ~front
            triangle[pending[seen]] = hits["primitive_ids"].numpy()[seen].astype(np.int64)
            uv = hits["primitive_uvs"].numpy()[seen]
            weights[pending[seen]] = np.concatenate([1 - uv.sum(axis=1, keepdims=True), uv], axis=1)
            rays[pending[through], :3] += (distance[through, None] + 1e-4) * rays[pending[through], 3:]
            pending = pending[through]
            if not len(pending):
                break
        return triangle, weights


def _directions(view: Viewpoint) -> np.ndarray:
    uv = pixel_grid(view.height, view.width).reshape(-1, 2)
    directions = unproject(uv, np.ones(len(uv)), view.K) @ view.world_from_camera[:3, :3].T
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def _doubled(K: np.ndarray) -> np.ndarray:
    doubled = K * np.array([[2.0], [2.0], [1.0]])
    doubled[:2, 2] += 0.5
    return doubled


def up_direction(support_plane: np.ndarray | None, world_from_cameras: np.ndarray) -> np.ndarray:
    """Unit vector (3,) that points up in the world frame: the support plane's normal, or else the cameras' mean."""
    if support_plane is not None and np.linalg.norm(support_plane[:3]) > 0.5:
        return support_plane[:3] / np.linalg.norm(support_plane[:3])
    mean = -world_from_cameras[:, :3, 1].mean(axis=0)
    length = float(np.linalg.norm(mean))
    return mean / length if length > 1e-3 else np.array([0.0, 0.0, 1.0])


def orbit_views(
    vertices: np.ndarray, world_from_cameras: np.ndarray, up: np.ndarray, *, height: int, width: int
) -> list[Viewpoint]:
    """Two viewpoints from above, to either side of the recording cameras: the first shows the cameras, too."""
    sample = vertices[:: max(len(vertices) // 20_000, 1)].astype(np.float64)
    low, high = np.percentile(sample, [1, 99], axis=0)
    centre, radius = (low + high) / 2, float(np.linalg.norm(high - low)) / 2
    sample = sample[((sample >= low) & (sample <= high)).all(axis=1)]
    K = np.array([[1.5 * height, 0, (width - 1) / 2], [0, 1.5 * height, (height - 1) / 2], [0, 0, 1]])
    eyes = world_from_cameras[:, :3, 3]
    towards = eyes.mean(axis=0) - centre
    level = towards - (towards @ up) * up
    if np.linalg.norm(level) < 0.2 * radius:  # Recorded from straight above, or from the inside.
        level = world_from_cameras[0, :3, 0] - (world_from_cameras[0, :3, 0] @ up) * up
    if np.linalg.norm(level) < 1e-6:
        level = np.linalg.svd(up[None])[2][1]
    level = level / np.linalg.norm(level)
    side = np.cross(up, level)
    # Distant cameras would shrink the mesh to a dot.
    near = eyes[np.linalg.norm(eyes - centre, axis=1) < 5 * radius]
    views = []
    for azimuth_deg, points in ((-45.0, np.concatenate([sample, near])), (45.0, sample)):
        azimuth, elevation = np.deg2rad([azimuth_deg, 35.0])
        heading = np.cos(elevation) * (np.cos(azimuth) * level + np.sin(azimuth) * side) + np.sin(elevation) * up
        rotation = _looking_along(-heading, up)
        world_from_camera = np.eye(4)
        world_from_camera[:3, :3] = rotation
        world_from_camera[:3, 3] = rotation @ _eye_that_sees(
            points @ rotation, width / 2 / K[0, 0], height / 2 / K[1, 1]
        )
        views.append(Viewpoint(K, world_from_camera, height, width))
    return views


def _eye_that_sees(points: np.ndarray, slope_x: float, slope_y: float) -> np.ndarray:
    """The nearest camera centre (3,) from which all points lie inside the image, along the camera's axes.

    A point p is left of the right edge if p_x - e_x <= slope (p_z - e_z), which is linear in the centre e; the other
    edges likewise.

    Args:
        points: (n, 3) along the camera's axes.
        slope_x, slope_y: half the image's size divided by the focal length.
    """
    margin = 0.92
    eye = np.zeros(3)
    farthest_back = []
    for axis, slope in ((0, margin * slope_x), (1, margin * slope_y)):
        high = (points[:, axis] - slope * points[:, 2]).max()
        low = (-points[:, axis] - slope * points[:, 2]).max()
        eye[axis] = (high - low) / 2
        farthest_back.append(-(high + low) / (2 * slope))
    eye[2] = min(farthest_back)
    return eye


def _looking_along(forward: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Rotation (3, 3) world_from_camera of a camera looking along `forward`, with `up` upwards in its image."""
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward], axis=1)


def draw_path(
    picture: np.ndarray, view: Viewpoint, world_from_cameras: np.ndarray, first: Colour, last: Colour
) -> np.ndarray:
    """The picture with the path of the recording cameras, in colours from `first` to `last`."""
    drawn = picture.copy()
    camera_from_world = invert_rigid(view.world_from_camera)
    pixel, _ = project(transform(camera_from_world, world_from_cameras[:, :3, 3]), view.K)
    share = np.linspace(0, 1, len(pixel))[:, None]
    colours = ((1 - share) * np.array(first) + share * np.array(last)).round().astype(int)
    inside = np.isfinite(pixel).all(axis=1) & (np.abs(pixel) < 8000).all(axis=1)
    for i in range(len(pixel)):
        colour = tuple(int(x) for x in colours[i])
        if inside[i] and i and inside[i - 1]:
            start, end = (tuple(int(x) for x in np.rint(pixel[j])) for j in (i - 1, i))
            cv2.line(drawn, start, end, colour, 2, cv2.LINE_AA)
        if inside[i] and (len(pixel) <= 60 or i % (len(pixel) // 60 + 1) == 0):
            cv2.circle(drawn, tuple(int(x) for x in np.rint(pixel[i])), 3, colour, -1, cv2.LINE_AA)
    return drawn
