"""Exact pairs of images for tests of training: views of an analytic scene, matched by geometry."""

from __future__ import annotations

from functools import cache

import numpy as np

from bask_data.core.geometry import in_image, invert_rigid, pixel_grid, project, transform, unproject
from bask_data.nn.occluders import N_INSTANCES
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

    @property
    def identities(self) -> np.ndarray:
        return np.zeros((1, N_INSTANCES), int)

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


RAMP_SIZE = (48, 64)
RAMP_STEP = 4
"""Grey levels per pixel of the surface: 64 pixels fill a byte."""
MARGIN = 6
"""Least distance of a match from the edge of its object, pixels; blending of object and background ends before it."""


class RampPairs:
    """Pairs of a plane whose colour encodes the position on it: red the column, green the row, blue the object.

    The position of a match can thus be read from a warped image, independently of the known warp. The first image shows
    the plane itself, the second an affine view of it, a different one for each pair.

    Args:
        n_objects: rectangles side by side, instances 1 and up.
    """

    def __init__(self, n_objects: int = 2, n_scans: int = 1, n_pairs: int = 3) -> None:
        self.n_objects = n_objects
        self.scans = np.repeat(np.arange(n_scans), n_pairs)
        self.n_instances = np.full(len(self.scans), n_objects)
        self.identities = np.zeros((n_scans, N_INSTANCES), int)
        self._pairs: dict[int, Pair] = {}

    @property
    def n_pairs(self) -> int:
        return len(self.scans)

    def marker(self, scan: int, instance: int) -> int:
        """Blue of an object, different in every scan."""
        return 60 + 20 * (scan * self.n_objects + instance)

    def instance_of(self, marker: float) -> int:
        return (round(marker - 60) // 20 - 1) % self.n_objects + 1

    def box(self, instance: int) -> tuple[float, float, float, float]:
        """Minimum u and v, maximum u and v of an object on the plane."""
        width = (RAMP_SIZE[1] - 4) / self.n_objects
        return 2 + (instance - 1) * width, 4.0, instance * width, 43.0

    def pair(self, i_pair: int) -> Pair:
        if i_pair not in self._pairs:
            self._pairs[i_pair] = self._made(i_pair)
        return self._pairs[i_pair]

    def _made(self, i_pair: int) -> Pair:
        b_from_a = self.b_from_a(i_pair)
        images = [self._seen(int(self.scans[i_pair]), matrix) for matrix in (np.eye(2, 3), b_from_a)]
        instance, uv_a = self.points()
        uv_b = uv_a @ b_from_a[:, :2].T + b_from_a[:, 2]
        inside = in_image(uv_b, *RAMP_SIZE)
        (rgb_a, instance_a), (rgb_b, instance_b) = images
        columns = (instance[inside], uv_a[inside].astype(np.float32), uv_b[inside].astype(np.float32))
        return Pair(rgb_a, rgb_b, instance_a, instance_b, *columns)

    def b_from_a(self, i_pair: int) -> np.ndarray:
        rng = np.random.default_rng(i_pair)
        angle, scale = rng.uniform(-0.3, 0.3), rng.uniform(0.85, 1.0)
        linear = scale * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        centre = (np.array(RAMP_SIZE[::-1]) - 1) / 2
        return np.column_stack([linear, centre + rng.uniform(-4, 4, 2) - linear @ centre])

    def points(self) -> tuple[np.ndarray, np.ndarray]:
        """Instance and position on the plane of all matches, far enough apart to be identified by a pixel."""
        instance, uv = [], []
        for i in range(1, self.n_objects + 1):
            u0, v0, u1, v1 = self.box(i)
            grid = np.meshgrid(np.arange(u0 + MARGIN, u1 - MARGIN, 5), np.arange(v0 + MARGIN, v1 - MARGIN, 5))
            uv.append(np.stack(grid, axis=-1).reshape(-1, 2) + np.random.default_rng(i).uniform(0, 1, 2))
            instance.append(np.full(len(uv[-1]), i, np.uint8))
        return np.concatenate(instance), np.concatenate(uv)

    def _seen(self, scan: int, view_from_plane: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        plane_from_view = np.linalg.inv(np.vstack([view_from_plane, [0, 0, 1]]))[:2]
        at = pixel_grid(*RAMP_SIZE) @ plane_from_view[:, :2].T + plane_from_view[:, 2]
        labels = np.zeros(RAMP_SIZE, np.uint8)
        blue = np.full(RAMP_SIZE, 20)
        for i in range(1, self.n_objects + 1):
            u0, v0, u1, v1 = self.box(i)
            inside = (at >= [u0, v0]).all(axis=-1) & (at <= [u1, v1]).all(axis=-1)
            labels[inside], blue[inside] = i, self.marker(scan, i)
        rgb = np.dstack([RAMP_STEP * at, blue])
        return np.clip(np.rint(rgb), 0, 255).astype(np.uint8), labels
