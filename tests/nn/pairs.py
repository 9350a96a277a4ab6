"""Exact pairs of images for tests of training: views of an analytic scene, matched by geometry."""

from __future__ import annotations

from functools import cache

import numpy as np

from bask_data.core.geometry import in_image, invert_rigid, pixel_grid, project, transform, unproject
from bask_data.nn.sampling import Pair
from tests.scenes import orbit, tabletop

SIZE = (96, 128)
K = np.array([[120.0, 0.0, 63.5], [0.0, 120.0, 47.5], [0.0, 0.0, 1.0]])


class ScenePairs:
    """All ordered pairs of the first views of an orbit around a few objects."""

    def __init__(self, n_views: int = 4, seed: int = 0, n_matches: int = 400) -> None:
        self._indices = [(a, b) for a in range(n_views) for b in range(n_views) if a != b]
        self._n_views, self._seed, self._n_matches = n_views, seed, n_matches

    @property
    def n_pairs(self) -> int:
        return len(self._indices)

    @property
    def scans(self) -> np.ndarray:
        return np.zeros(self.n_pairs, int)

    @property
    def n_instances(self) -> np.ndarray:
        return np.full(self.n_pairs, 3)

    def pair(self, i_pair: int) -> Pair:
        return _pair(self._n_views, self._seed, *self._indices[i_pair], self._n_matches)


@cache
def views(n_views: int, seed: int):
    scene = tabletop(3, seed=seed, spread=0.12)
    world_from_cameras = orbit(n_views, radius=0.6, elevation_deg=(35.0, 60.0), n_turns=0.25)
    return scene, world_from_cameras, [scene.render(K, pose, *SIZE) for pose in world_from_cameras]


@cache
def _pair(n_views: int, seed: int, a: int, b: int, n_matches: int) -> Pair:
    _, world_from_cameras, images = views(n_views, seed)
    uv = pixel_grid(*SIZE)[images[a].instance > 0]
    instance = images[a].instance[images[a].instance > 0]
    depth = images[a].depth[images[a].instance > 0].astype(float)
    points_b = transform(invert_rigid(world_from_cameras[b]), transform(world_from_cameras[a], unproject(uv, depth, K)))
    uv_b, z_b = project(points_b, K)
    inside = in_image(uv_b, *SIZE)
    column, row = np.rint(np.where(inside[:, None], uv_b, 0)).astype(int).T
    seen = inside & (images[b].instance[row, column] == instance) & (np.abs(images[b].depth[row, column] - z_b) < 5e-3)
    chosen = np.flatnonzero(seen)
    chosen = np.random.default_rng(0).permutation(chosen)[:n_matches]
    return Pair(
        rgb_a=images[a].rgb,
        rgb_b=images[b].rgb,
        instance_a=images[a].instance,
        instance_b=images[b].instance,
        instance=instance[chosen],
        uv_a=uv[chosen].astype(np.float32),
        uv_b=uv_b[chosen].astype(np.float32),
    )
