"""Depth of a camera beside registered into colour, against what can be put together from libraries.

Open3D casts a ray through each pixel of colour at the same triangles between neighbouring depths: the same image, but
for the margin around near surfaces. NumPy draws each depth as the square of its pixel, sorted from far to near, which
leaves holes where surfaces are inclined and the background in gaps of the foreground. OpenCV does still less, one pixel
per depth and its neighbours if they are empty. Colour at depth's size is compared with OpenCV's mean over areas, which
knows sizes and no intrinsics.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import cv2
import numpy as np
import open3d as o3d

from bask_data.core.depth import DEPTH_SLACK
from bask_data.core.geometry import pixel_grid, project, scale_intrinsics, transform, unproject
from bask_data.core.registration import color_at_depth_size, registered_depth
from tests.scenes import intrinsics, orbit, tabletop

COLOR_FROM_DEPTH = np.eye(4)
COLOR_FROM_DEPTH[0, 3] = 0.025


def cases() -> Iterator[tuple[str, Callable[[], object], Callable[[], object]]]:
    """A table with six objects, the cameras 25 mm apart; and a phone's colour image of noise."""
    for depth_size, color_size in (((240, 320), (480, 640)), ((480, 640), (720, 1280))):
        (h, w), (height, width) = depth_size, color_size
        depth_K, color_K = intrinsics(h, w), intrinsics(height, width)
        depth = tabletop(6).render(depth_K, orbit(4, radius=0.6)[1] @ COLOR_FROM_DEPTH, h, w).depth
        name = f"depth {w}x{h} into colour {width}x{height}"
        given = (depth, depth_K, color_K, color_size, COLOR_FROM_DEPTH)
        yield f"{name}, Open3D casts rays", lambda g=given: registered_depth(*g), lambda g=given: cast(*g)
        yield f"{name}, NumPy draws squares", lambda g=given: registered_depth(*g), lambda g=given: squares(*g)
        if hasattr(cv2, "registerDepth"):
            yield f"{name}, OpenCV, with holes", lambda g=given: registered_depth(*g), lambda g=given: opencv(*g)
    size, new = (1440, 1920), (192, 256)
    rgb = np.random.default_rng(0).integers(0, 256, (*size, 3)).astype(np.uint8)
    K, new_K = intrinsics(*size), scale_intrinsics(intrinsics(*size), size, new)
    yield (
        "colour 1920x1440 at the size of depth 256x192",
        lambda: color_at_depth_size(rgb, K, new_K, new),
        lambda: cv2.resize(rgb, new[::-1], interpolation=cv2.INTER_AREA),
    )


def cast(
    depth: np.ndarray,
    depth_K: np.ndarray,
    color_K: np.ndarray,
    color_size: tuple[int, int],
    color_from_depth: np.ndarray,
) -> np.ndarray:
    """Depth where rays of the colour camera meet the triangles."""
    height, width = depth.shape
    points = transform(color_from_depth, unproject(pixel_grid(height, width), depth.astype(float), depth_K))
    index = np.arange(height * width).reshape(height, width)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
    triangles = np.concatenate([np.stack(corners, axis=-1).reshape(-1, 3) for corners in ((a, b, c), (d, c, b))])
    corner_depth = depth.reshape(-1)[triangles]
    least = corner_depth.min(axis=1)
    is_surface = (least > 0) & (corner_depth.max(axis=1) - least <= DEPTH_SLACK[0] + DEPTH_SLACK[1] * least)
    scene = o3d.t.geometry.RaycastingScene()
    from_numpy = o3d.core.Tensor.from_numpy
    scene.add_triangles(
        from_numpy(points.reshape(-1, 3).astype(np.float32)), from_numpy(triangles[is_surface].astype(np.uint32))
    )
    directions = unproject(pixel_grid(*color_size), np.ones(color_size), color_K)
    rays = np.concatenate([np.zeros_like(directions), directions], axis=-1).astype(np.float32)
    hit = scene.cast_rays(from_numpy(rays))["t_hit"].numpy()
    return np.where(np.isfinite(hit), hit, np.float32(0))


def squares(
    depth: np.ndarray,
    depth_K: np.ndarray,
    color_K: np.ndarray,
    color_size: tuple[int, int],
    color_from_depth: np.ndarray,
) -> np.ndarray:
    """Every depth at all pixels of colour that its own pixel covers, the nearest last."""
    height, width = depth.shape
    points = transform(color_from_depth, unproject(pixel_grid(height, width), depth.astype(float), depth_K))
    uv, z = project(points[depth > 0], color_K)
    order = np.argsort(-z)
    uv, z = uv[order], z[order].astype(np.float32)
    n = int(np.ceil(color_K[0, 0] / depth_K[0, 0]))
    first = np.ceil(uv - n / 2).astype(np.int64)
    u, v = first[:, None, 0] + np.tile(np.arange(n), n), first[:, None, 1] + np.repeat(np.arange(n), n)
    inside = (u >= 0) & (v >= 0) & (u < color_size[1]) & (v < color_size[0])
    result = np.zeros(color_size, np.float32)
    result[v[inside], u[inside]] = np.broadcast_to(z[:, None], u.shape)[inside]
    return result


def opencv(
    depth: np.ndarray,
    depth_K: np.ndarray,
    color_K: np.ndarray,
    color_size: tuple[int, int],
    color_from_depth: np.ndarray,
) -> np.ndarray:
    return cv2.registerDepth(depth_K, color_K, np.zeros(5), color_from_depth, depth, color_size[::-1], None, True)
