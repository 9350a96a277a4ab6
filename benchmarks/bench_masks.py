"""Visible masks of a frame against casting one ray through each of its pixels at the same mesh.

Ours combines rays with measured depth and counts how much of each object is occluded; it casts rays only where an
object may be. In the second case objects fill the image, so no ray can be left out; in the third a third of the depth
is missing too, in patches, so that holes and colours are evaluated. Everything the stage does for a frame is included
except reading and writing. Target: a ratio of 0.77 (1.3 times as long).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import open3d as o3d

from bask_data.core.depth import filled, in_range
from bask_data.core.tsdf import Volume
from bask_data.core.visibility.completion import Completion
from bask_data.core.visibility.labelled import LabelledSurface
from bask_data.core.visibility.sensor import MASK_TOLERANCE
from bask_data.core.visibility.surface import ray_directions, rays_of
from bask_data.core.visibility.visible import MeasuredFrame, visible_instances
from tests.scenes import Scene, intrinsics, noisy, orbit, tabletop

HEIGHT, WIDTH = 480, 640
VOXEL = 0.004


def cases() -> Iterator[tuple[str, Callable[[], object], Callable[[], object]]]:
    """Ten frames of a table with six objects, 640x480, 1 mm of noise, from afar and from close by."""
    for name, radius, with_holes in (
        ("objects on a table", 0.7, False),
        ("objects fill the image", 0.22, False),
        ("objects fill the image, a third not measured", 0.22, True),
    ):
        yield f"masks, {name}", *both(tabletop(6), orbit(10, radius=radius, elevation_deg=(40.0, 70.0)), with_holes)


def both(scene: Scene, cameras: np.ndarray, with_holes: bool) -> tuple[Callable[[], object], Callable[[], object]]:
    """Ours and the bare cast over the same frames and the same mesh, fused from views all around."""
    K = intrinsics(HEIGHT, WIDTH)
    rng = np.random.default_rng(0)
    volume = Volume(VOXEL)
    for camera in orbit(20):
        view = scene.render(K, camera, HEIGHT, WIDTH)
        volume.integrate(noisy(view.depth, 0.001, rng), view.rgb, K, camera)
    mesh = volume.mesh()
    labels = scene.instance_at(mesh.vertices.astype(np.float64), 0.002)
    surface = LabelledSurface(mesh.vertices, mesh.triangles, labels, scene.n_objects, mesh.colors)
    bare = o3d.t.geometry.RaycastingScene()
    from_numpy = o3d.core.Tensor.from_numpy
    bare.add_triangles(from_numpy(mesh.vertices), from_numpy(mesh.triangles.astype(np.uint32)))
    directions = ray_directions(K, HEIGHT, WIDTH)
    views = [scene.render(K, camera, HEIGHT, WIDTH) for camera in cameras]
    depth = [noisy(view.depth, 0.001, rng) for view in views]
    if with_holes:
        coarse = (HEIGHT // 20, WIDTH // 20)
        holes = [np.kron(rng.random(coarse) < 1 / 3, np.ones((20, 20), bool)) for _ in depth]
        depth = [np.where(hole, np.float32(0), one) for hole, one in zip(holes, depth, strict=True)]
    completion = Completion(mesh.vertices, labels, reach=VOXEL)
    for one, camera in zip(depth, cameras, strict=True):
        completion.carve(one, K, camera, MASK_TOLERANCE)
    completion.finish()
    everywhere = np.ones((HEIGHT, WIDTH), bool)
    rays = [from_numpy(rays_of(directions, camera).through(everywhere)) for camera in cameras]

    def ours() -> object:
        return [
            visible_instances(
                surface,
                MeasuredFrame(filled(in_range(measured, 0.0, 10.0)), directions, K, camera, view.rgb),
                completion=completion,
            )
            for measured, view, camera in zip(depth, views, cameras, strict=True)
        ]

    def plain() -> object:
        return [bare.cast_rays(frame) for frame in rays]

    return ours, plain
