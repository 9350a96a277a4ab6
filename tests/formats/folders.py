"""Small folders of frames with known content, in the layout of users' dumps."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float
from numpy import ndarray

from bask_data.formats.recording import SourceRecording

HEIGHT, WIDTH = 12, 16
INTRINSICS = "20,21,7.5,5.5"
K = np.array([[20.0, 0, 7.5], [0, 21, 5.5], [0, 0, 1]])


def rigid(rng: np.random.Generator) -> Float[ndarray, "4 4"]:
    """A random rigid transform."""
    rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    matrix = np.eye(4)
    matrix[:3, :3] = rotation * np.sign(np.linalg.det(rotation))
    matrix[:3, 3] = rng.normal(size=3)
    return matrix


def images(n: int, seed: int = 0) -> tuple[ndarray, ndarray]:
    """Colour (n,h,w,3) u8, and depth (n,h,w) u16 of about a metre in millimetres, with holes."""
    rng = np.random.default_rng(seed)
    color = rng.integers(0, 256, (n, HEIGHT, WIDTH, 3), dtype=np.uint8)
    depth = rng.integers(500, 1500, (n, HEIGHT, WIDTH), dtype=np.uint16)
    depth[rng.random(depth.shape) < 0.2] = 0
    return color, depth


def write_image(path: Path, image: ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image[..., ::-1] if image.ndim == 3 else image)


def write_frames(folder: Path, poses: Float[ndarray, "t 4 4"], names: list[str] | None = None, seed: int = 0) -> None:
    """`frame-<name>.color.png`, `.depth.png` and `.pose.txt` for each pose."""
    color, depth = images(len(poses), seed)
    names = names or [f"{i:06d}" for i in range(len(poses))]
    for name, pose, rgb, z in zip(names, poses, color, depth, strict=True):
        write_image(folder / f"frame-{name}.color.png", rgb)
        write_image(folder / f"frame-{name}.depth.png", z)
        np.savetxt(folder / f"frame-{name}.pose.txt", pose)


def median_depth_disagreement(recording: SourceRecording, a: int, b: int) -> float:
    """Median difference, metres, between the depth of frame a moved into frame b and the depth measured in b."""
    from bask_data.core.geometry import in_image, invert_rigid, pixel_grid, project, transform, unproject

    camera = recording.cameras[0]
    depth_a, depth_b = (camera.read(i)[1] * camera.depth_scale for i in (a, b))
    seen = depth_a > 0
    points_a = unproject(pixel_grid(camera.height, camera.width)[seen], depth_a[seen], camera.K)
    b_from_a = invert_rigid(camera.world_from_cameras[b]) @ camera.world_from_cameras[a]
    uv, z = project(transform(b_from_a, points_a), camera.K)
    inside = in_image(uv, camera.height, camera.width)
    u, v = np.rint(uv[inside]).astype(int).T
    measured = depth_b[v, u]
    return float(np.median(np.abs(z[inside] - measured)[measured > 0]))
