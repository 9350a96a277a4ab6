"""Matches of pairs of views against a plain loop over matches, and against a plain NumPy version of a pair.

The plain versions do what is usual and no more: measured depth, the depth of the nearest pixel in the other view and
its mask; no sub-pixel depth and no cycle check. All get frames in memory, and each pair loads its masks afresh.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from bask_data.core.correspondences.matchable import MatchableView, matchable_view
from bask_data.core.correspondences.search import match

HEIGHT, WIDTH = 480, 640
N_ATTEMPTS, N_MATCHES = 4000, 1000
K = np.array([[554.0, 0, 319.5], [0, 554.0, 239.5], [0, 0, 1.0]])
N_FRAMES, N_PAIRS = 12, 60


def frames() -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Depth, labels and camera of three spheres on a table z = 0, seen from a circle."""
    made = []
    v, u = np.mgrid[:HEIGHT, :WIDTH].astype(float)
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], axis=-1)
    for azimuth in np.linspace(0, 1.5, N_FRAMES):
        eye = np.array([0.5 * np.cos(azimuth), 0.5 * np.sin(azimuth), 0.4])
        forward = -eye / np.linalg.norm(eye)
        right = np.cross(forward, [0, 0, 1.0])
        right /= np.linalg.norm(right)
        world_from_camera = np.eye(4)
        world_from_camera[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
        world_from_camera[:3, 3] = eye
        directions = rays @ world_from_camera[:3, :3].T
        nearest = -eye[2] / np.minimum(directions[..., 2], -1e-6)
        label = np.zeros((HEIGHT, WIDTH), np.uint8)
        for i, centre in enumerate([(0.1, 0.0, 0.0), (-0.1, 0.08, 0.0), (-0.05, -0.12, 0.0)]):
            offset = eye - centre
            a, b = (directions**2).sum(axis=-1), directions @ offset
            inside = b**2 - a * (offset @ offset - 0.06**2)
            hit = np.where(inside > 0, (-b - np.sqrt(np.maximum(inside, 0))) / a, np.inf)
            label[hit < nearest] = i + 1
            nearest = np.minimum(nearest, hit)
        made.append((np.minimum(nearest, 3.0).astype(np.float32), label, world_from_camera))
    return made


def numpy_pair(a: tuple, b: tuple, rng: np.random.Generator) -> int:
    """Lift the masked pixels of one image, project all, test, and draw."""
    depth_a, label_a, world_from_a = a
    depth_b, label_b, world_from_b = b
    v, u = np.nonzero(label_a)
    z = depth_a[v, u].astype(float)
    points_a = np.stack([(u - K[0, 2]) / K[0, 0] * z, (v - K[1, 2]) / K[1, 1] * z, z, np.ones_like(z)], axis=1)
    points_b = points_a @ (np.linalg.inv(world_from_b) @ world_from_a).T
    pixel = points_b[:, :3] @ K.T
    pixel = pixel[:, :2] / pixel[:, 2:]
    column, row = np.rint(pixel).astype(int).T
    ok = (column >= 0) & (column < WIDTH) & (row >= 0) & (row < HEIGHT)
    column, row = np.clip(column, 0, WIDTH - 1), np.clip(row, 0, HEIGHT - 1)
    ok &= np.abs(depth_b[row, column] - points_b[:, 2]) < 0.005 + 0.01 * points_b[:, 2]
    ok &= label_b[row, column] == label_a[v, u]
    kept = rng.permutation(np.flatnonzero(ok))[:N_MATCHES]
    return len(np.concatenate([np.stack([u, v], axis=1)[kept], pixel[kept]], axis=1))


def loop_pair(a: tuple, b: tuple, rng: np.random.Generator) -> int:
    """The same, one drawn pixel after the other."""
    depth_a, label_a, world_from_a = a
    depth_b, label_b, world_from_b = b
    b_from_a, inverse = np.linalg.inv(world_from_b) @ world_from_a, np.linalg.inv(K)
    candidates = np.argwhere(label_a > 0)
    matches = []
    for i in rng.permutation(len(candidates))[:N_ATTEMPTS]:
        v, u = candidates[i]
        point = b_from_a @ np.append(inverse @ [u, v, 1.0] * depth_a[v, u], 1.0)
        pixel = K @ (point[:3] / point[2])
        column, row = round(float(pixel[0])), round(float(pixel[1]))
        if not (0 <= column < WIDTH and 0 <= row < HEIGHT) or label_b[row, column] != label_a[v, u]:
            continue
        if abs(depth_b[row, column] - point[2]) < 0.005 + 0.01 * point[2]:
            matches.append((u, v, pixel[0], pixel[1]))
        if len(matches) == N_MATCHES:
            break
    return len(matches)


def cases() -> Iterator[tuple[str, Callable[[], object], Callable[[], object]]]:
    given = frames()
    order = np.random.default_rng(0).integers(N_FRAMES, size=(N_PAIRS, 2))

    def ours() -> int:
        # Frames are prepared once for all their pairs, which is counted here.
        rng, ready = np.random.default_rng(0), dict[int, MatchableView]()
        n_matches = 0
        for pair in order.tolist():
            for i in pair:
                if i not in ready:
                    ready[i] = matchable_view(given[i][0], given[i][1], K, given[i][2])
            n_matches += len(match(ready[pair[0]], ready[pair[1]], rng, N_ATTEMPTS, N_MATCHES).instance)
        return n_matches

    def plain(pair_of: Callable[[tuple, tuple, np.random.Generator], int]) -> Callable[[], int]:
        def all_pairs() -> int:
            rng = np.random.default_rng(0)
            return sum(pair_of(given[a], given[b], rng) for a, b in order.tolist())

        return all_pairs

    yield f"{N_PAIRS} pairs of views, loop over matches", ours, plain(loop_pair)
    yield f"{N_PAIRS} pairs of views, NumPy a pair", ours, plain(numpy_pair)
