"""The whole stage `reconstruct` against the bare Open3D loop it is built on.

The two sides do not do the same work: ours reads every frame from the dataset, cleans its depth, surveys the scan for
the workspace, extracts the mesh and writes it; the bare loop only integrates frames from memory into a volume of known
size. Target: a ratio of 0.9.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import open3d as o3d

from bask_data.core.geometry import invert_rigid
from bask_data.dataset import Dataset
from bask_data.kinds import Scan
from bask_data.stages.reconstruct import ReconstructParams, reconstruct
from tests.datasets import publish_recording
from tests.scenes import intrinsics, noisy, orbit, tabletop

HEIGHT, WIDTH = 480, 640
N_VIEWS, N_FRAMES = 20, 200
VOXEL = 0.004


def cases() -> Iterator[tuple[str, Callable[[], object], Callable[[], object]]]:
    """A table with six objects, 640x480, 1 mm of noise."""
    scene, K, views = tabletop(6), intrinsics(HEIGHT, WIDTH), orbit(N_VIEWS)
    rng = np.random.default_rng(0)
    seen = [scene.render(K, camera, HEIGHT, WIDTH) for camera in views]
    order = np.arange(N_FRAMES) % N_VIEWS
    depth = [noisy(seen[i].depth, 0.001, rng) for i in order]
    rgb = [seen[i].rgb for i in order]
    cameras = views[order]
    folder = Path(tempfile.mkdtemp(prefix="bask-benchmark-"))
    try:
        dataset = Dataset.create(folder / "dataset")
        publish_recording(dataset, "a", rgb=rgb, depth=depth, K=K, world_from_cameras=cameras)
        scan = Scan(dataset.path(Scan, "a"))

        def ours() -> object:
            out = Path(tempfile.mkdtemp(dir=folder))
            reconstruct(scan=scan, params=ReconstructParams(voxel_size=VOXEL), out=out)
            shutil.rmtree(out)
            return None

        def plain() -> object:
            return integrate(depth, rgb, K, cameras)

        yield f"reconstruct, {N_FRAMES} frames at 4 mm", ours, plain
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def integrate(depth: list[np.ndarray], rgb: list[np.ndarray], K: np.ndarray, cameras: np.ndarray) -> object:
    """Open3D's own example of integration."""
    core, Image = o3d.core, o3d.t.geometry.Image
    float32, channels = core.float32, [core.SizeVector([n]) for n in (1, 1, 3)]
    grid = o3d.t.geometry.VoxelBlockGrid(
        ("tsdf", "weight", "color"), (float32, float32, float32), channels, VOXEL, 8, 20_000
    )
    K_tensor = core.Tensor.from_numpy(K)
    for measured, colour, world_from_camera in zip(depth, rgb, cameras, strict=True):
        depth_image = Image(core.Tensor.from_numpy(measured))
        rgb_image = Image(core.Tensor.from_numpy(colour.astype(np.float32) / 255))
        camera_from_world = core.Tensor.from_numpy(invert_rigid(world_from_camera))
        blocks = grid.compute_unique_block_coordinates(depth_image, K_tensor, camera_from_world, 1.0, 4.0, 5.0)
        grid.integrate(blocks, depth_image, rgb_image, K_tensor, K_tensor, camera_from_world, 1.0, 4.0, 5.0)
    return grid
