"""Training batches against a plain way of making them.

A plain pair tries 10 000 pixels of the object one by one, projects each, and searches for non-matches one by one; ours
reads precomputed matches and draws all non-matches together. Both augment their images in the same way.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from bask_data.core.geometry import invert_rigid
from bask_data.nn.augment import AugmentedView, AugmentSettings, layer
from bask_data.nn.augment_look import random_ground, random_look
from bask_data.nn.augment_motion import covered, moved, random_affine, warped_labels
from bask_data.nn.rendering import drawn
from bask_data.nn.sampling import Pair, SampleSettings, batch_of_step
from tests.scenes import intrinsics, orbit, tabletop

SIZE = (256, 256)
K = intrinsics(*SIZE)
N_VIEWS = 6
SAMPLE = SampleSettings(SIZE, n_pairs=1, n_matches=256, n_non_matches=150)
AUGMENT = AugmentSettings()


@dataclass
class Scene:
    """Views of a table in memory, with the matches that `correspondences` would have found."""

    n_pairs: int = N_VIEWS - 1

    def __post_init__(self) -> None:
        self.scans, self.n_instances = np.zeros(self.n_pairs, int), np.full(self.n_pairs, 4)
        scene = tabletop(4)
        self.cameras = orbit(N_VIEWS, n_turns=0.2)
        self.views = [scene.render(K, camera, *SIZE) for camera in self.cameras]
        self.matches = [self._found(i) for i in range(self.n_pairs)]

    def _found(self, i: int) -> Pair:
        a, b = self.views[i], self.views[i + 1]
        attempts = np.random.default_rng(i)
        uv_a, uv_b, instance = [], [], []
        rows, columns = np.nonzero(a.instance)
        b_from_a = invert_rigid(self.cameras[i + 1]) @ self.cameras[i]
        for j in attempts.integers(len(rows), size=4000):
            other = match(a.depth, b.depth, b_from_a, columns[j], rows[j])
            if other is not None:
                uv_a.append((columns[j], rows[j]))
                uv_b.append(other)
                instance.append(a.instance[rows[j], columns[j]])
        pixels = [np.array(uv, np.float32) for uv in (uv_a, uv_b)]
        return Pair(a.rgb, b.rgb, a.instance, b.instance, np.array(instance, np.uint8), *pixels)

    def pair(self, i_pair: int) -> Pair:
        return self.matches[i_pair]


def match(depth_a: np.ndarray, depth_b: np.ndarray, b_from_a: np.ndarray, u: int, v: int) -> tuple[float, float] | None:
    """The pixel of the second view that shows what the first shows at (u, v)."""
    z = float(depth_a[v, u])
    x, y = (u - K[0, 2]) / K[0, 0] * z, (v - K[1, 2]) / K[1, 1] * z
    x, y, z = b_from_a[:3, :3] @ [x, y, z] + b_from_a[:3, 3]
    u_b, v_b = K[0, 0] * x / z + K[0, 2], K[1, 1] * y / z + K[1, 2]
    column, row = round(u_b), round(v_b)
    if not (0 <= column < SIZE[1] and 0 <= row < SIZE[0]) or abs(depth_b[row, column] - z) > 0.005:
        return None
    return u_b, v_b


def plain_image(
    rgb: np.ndarray, instance: np.ndarray, affine: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """An image and its labels, changed as ours are."""
    labels = warped_labels(instance, affine, SIZE)
    shown = labels > 0 if rng.random() < AUGMENT.background else covered(instance.shape, affine, SIZE)
    ground = () if shown is None else (random_ground(SIZE, rgb, instance, rng),)
    return drawn(AugmentedView(SIZE, (*ground, layer(rgb, affine, shown)), random_look(rgb, AUGMENT, rng))), labels


def plain_batch(source: Scene, step: int, n_attempts: int) -> list[tuple[int, int, bool]]:
    """A batch of one pair, pixel by pixel."""
    rng = np.random.default_rng(step)
    i = int(rng.integers(source.n_pairs))
    a, b = source.views[i], source.views[i + 1]
    b_from_a = invert_rigid(source.cameras[i + 1]) @ source.cameras[i]
    chosen = rng.choice(np.unique(a.instance[a.instance > 0]))
    rows, columns = np.nonzero(a.instance == chosen)
    found = []
    for j in rng.integers(len(rows), size=n_attempts):
        other = match(a.depth, b.depth, b_from_a, columns[j], rows[j])
        if other is not None:
            found.append(((columns[j], rows[j]), other))
    kept = [found[j] for j in rng.integers(len(found), size=SAMPLE.n_matches)]
    images = []
    for rgb, instance, uv in ((a.rgb, a.instance, kept[0][0]), (b.rgb, b.instance, kept[0][1])):
        affine = random_affine(SIZE, SIZE, np.array(uv, float), False, AUGMENT, rng)
        images.append((*plain_image(rgb, instance, affine, rng), affine))
    mask, affine = images[1][1] == chosen, images[1][2]
    non_matches = []
    for _, uv_b in kept:
        u, v = moved(affine, np.array([uv_b]))[0]
        n = 0
        while n < SAMPLE.n_non_matches:
            column, row = rng.integers(SIZE[1]), rng.integers(SIZE[0])
            if np.hypot(column - u, row - v) >= SAMPLE.clearance:
                non_matches.append((int(column), int(row), bool(mask[row, column])))
                n += 1
    return non_matches


def cases() -> Iterator[tuple[str, Callable[[], object], Callable[[], object]]]:
    source = Scene()
    for name, augment in (("", AUGMENT), (", other objects pasted in", replace(AUGMENT, composition=1.0))):
        yield (
            f"a batch of one pair, 256 x 150 non-matches{name}",
            lambda augment=augment: batch_of_step(source, 0, 1, SAMPLE, augment),
            lambda: plain_batch(source, 1, 10_000),
        )
