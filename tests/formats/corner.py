"""A textured corner of a room, two planes, as images and depth whose poses and depths are known by formula."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
from jaxtyping import Float, Float32, UInt8
from numpy import ndarray

from bask_data.core.geometry import invert_rigid, pixel_grid, project, transform, unproject
from tests.formats.folders import write_image

SIZE = (240, 320)
K = np.array([[300.0, 0, 158.0], [0, 300.0, 121.0], [0, 0, 1]])
INTRINSICS = "300,300,158,121"


def poses(n: int) -> Float[ndarray, "n 4 4"]:
    """Cameras on an arc of 60 degrees about the corner's middle, 0.9 m away, at changing heights."""
    result = []
    for i, angle in enumerate(np.linspace(-0.5, 0.5, n)):
        centre = np.array([0.9 * np.sin(angle), -0.9 * np.cos(angle), 0.5 + 0.04 * (i % 3)])
        forward = np.array([0, 0.05, 0.1]) - centre
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0, 0, 1.0])
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
        pose[:3, 3] = centre
        result.append(pose)
    return np.stack(result)


def rendered(world_from_camera: Float[ndarray, "4 4"]) -> tuple[UInt8[ndarray, "h w 3"], Float32[ndarray, "h w"]]:
    """Colour, and z-depth in metres: the floor is z = 0, the wall y = 0.2."""
    rays = unproject(pixel_grid(*SIZE), np.ones(SIZE), K) @ world_from_camera[:3, :3].T
    origin = world_from_camera[:3, 3]
    with np.errstate(divide="ignore"):
        floor, wall = -origin[2] / rays[..., 2], (0.2 - origin[1]) / rays[..., 1]
    depth = np.minimum(np.where(floor > 0, floor, np.inf), np.where(wall > 0, wall, np.inf))
    points = origin + depth[..., None] * rays
    on_wall = wall <= floor
    on_wall |= floor <= 0
    texture = _texture()
    across = (points[..., 0] + 1.5) * 500
    up = np.where(on_wall, 1000 + points[..., 2] * 500, (points[..., 1] + 1.5) * 500)
    color = cv2.remap(texture, across.astype(np.float32), up.astype(np.float32), cv2.INTER_LINEAR)
    return color, depth.astype(np.float32)


@lru_cache(1)
def _texture() -> UInt8[ndarray, "h w 3"]:
    """Random blobs of two sizes: 2 mm per pixel."""
    rng = np.random.default_rng(0)
    fine, coarse = (cv2.GaussianBlur(rng.normal(size=(1800, 1600, 3)), (0, 0), s) * s for s in (2.0, 6.0))
    return np.clip(128 + 100 * (fine + coarse), 0, 255).astype(np.uint8)


def write_corner(folder: Path, world_from_cameras: Float[ndarray, "n 4 4"], gripper: bool = False) -> None:
    """`images/0000.png` and on, and `depth/0000.png`, millimetres.

    Args:
        gripper: whether the lower third of each image shows the same thing, which has no depth.
    """
    for i, pose in enumerate(world_from_cameras):
        color, depth = rendered(pose)
        if gripper:
            color[-80:], depth[-80:] = _texture()[:80, : SIZE[1]], 0
        write_image(folder / "images" / f"{i:04d}.png", color)
        write_image(folder / "depth" / f"{i:04d}.png", np.rint(1000 * depth).astype(np.uint16))


def model(world_from_cameras: Float[ndarray, "n 4 4"], metres_per_unit: float, cameras: Sequence[Any] = ()) -> Any:
    """A model of the images, with points at random pixels of every third image, in a world that is turned and scaled.

    Args:
        cameras: one for each image; by default one pinhole camera for all.
    """
    rng = np.random.default_rng(0)
    result = pycolmap.Reconstruction()
    for number, each in enumerate(cameras or [camera()], start=1):
        each.camera_id = number
        result.add_camera_with_trivial_rig(each)
    points = []
    for pose in world_from_cameras[::3]:
        _, depth = rendered(pose)
        uv = rng.uniform([5, 5], [SIZE[1] - 6, SIZE[0] - 6], (60, 2)).round()
        z = depth[uv[:, 1].astype(int), uv[:, 0].astype(int)]
        points.append(transform(pose, unproject(uv, z.astype(np.float64), K)))
    world = model_from_world()
    points_model = transform(world, np.concatenate(points)) / metres_per_unit
    numbers = [result.add_point3D(point, pycolmap.Track()) for point in points_model]
    for i, pose in enumerate(world_from_cameras):
        uv, z = project(transform(invert_rigid(pose), np.concatenate(points)), K)
        seen = (z > 0) & (uv > 2).all(axis=1) & (uv < [SIZE[1] - 3, SIZE[0] - 3]).all(axis=1)
        camera_from_model = invert_rigid(world @ pose)
        camera_from_model[:3, 3] /= metres_per_unit
        image = pycolmap.Image(
            name=f"{i:04d}.png",
            image_id=i + 1,
            camera_id=i + 1 if cameras else 1,
            points2D=pycolmap.Point2DList([pycolmap.Point2D(xy + 0.5) for xy in uv[seen]]),
        )
        result.add_image_with_trivial_frame(image, pycolmap.Rigid3d(camera_from_model[:3]))
        for index, k in enumerate(np.flatnonzero(seen)):
            result.add_observation(numbers[k], pycolmap.TrackElement(i + 1, index))
    return result


def camera(model: str = "PINHOLE", *distortion: float, size: tuple[int, int] = SIZE) -> Any:
    """COLMAP's camera with our K, whose pixel (0, 0) is the corner of the image."""
    focal = [300.0] if model.startswith("SIMPLE") else [300.0, 300.0]
    values = [*focal, K[0, 2] + 0.5, K[1, 2] + 0.5, *distortion]
    return pycolmap.Camera(model=model, width=size[1], height=size[0], params=values)


def model_from_world() -> Float[ndarray, "4 4"]:
    """The model's world: turned about z, and moved (metres)."""
    result = np.eye(4)
    result[:2, :2] = [[0.6, -0.8], [0.8, 0.6]]
    result[:3, 3] = [1.0, -2.0, 0.5]
    return result


def write_model(folder: Path, reconstruction: Any, text: bool = False) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    (reconstruction.write_text if text else reconstruction.write_binary)(str(folder))
