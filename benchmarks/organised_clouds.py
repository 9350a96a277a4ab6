"""How well single views of cluttered tables are split into objects: `python benchmarks/organised_clouds.py DIR`.

DIR holds labelled organised clouds as PCD files (labels as in the modified Object Segmentation Database: 0 invalid, 1
to 9 the table, else object = label // 10). Each view becomes a surface of triangles between neighbouring pixels at
similar depths and is split as `bask-data objects` does with its defaults.

The F-score of an object and an instance is 2 |A and B| / (|A| + |B|), where A and B are their points without invalid
ones. The best one-to-one assignment of instances to objects counts. The F-score of a scene is the mean over its
objects, a missed one with 0; surplus instances are counted in a column of their own.

In a single view an occluder may cut an object into distant parts. The labels distinguish these (20, 21, ...); parts
whose surface goes on behind the occluder are joined: *by part* is the mean over connected parts, *strict* the one over
whole objects with a 0 for each instance that belongs to none. Objects *touch* when a point of one is within eps of a
point of another: they are divided at creases, as where all cameras look from one side, and have a mean of their own.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))  # The reader is among the tests.

from bask_data.core.objects import SplitSettings, split_objects
from bask_data.core.planes import upward
from bask_data.core.sightings import PosedDepth
from bask_data.stages.objects import ObjectsParams
from tests.organised_clouds import CAMERA, read_pcd, surface_of

VOXEL_SIZE = 0.004
"""Metres; what a depth camera resolves at a metre, and the pipeline's default."""
K = np.array([[CAMERA[0], 0, CAMERA[2]], [0, CAMERA[1], CAMERA[3]], [0, 0, 1]])
PER_OBJECT, FIRST_OBJECT = 10, 2


def f_scores(truth: np.ndarray, found: np.ndarray) -> tuple[float, float]:
    """The scene's F-score, and the strict one; both (n,) int, 0 for the background."""
    objects, instances = np.unique(truth[truth > 0]), np.unique(found[found > 0])
    both = np.array([[2 * np.sum((truth == a) & (found == b)) for b in instances] for a in objects])
    sizes = np.array([[np.sum(truth == a) + np.sum(found == b) for b in instances] for a in objects])
    if not both.size:
        return 0.0, 0.0
    scores = both / sizes
    a, b = linear_sum_assignment(-scores)
    n_apart = len(objects) + len(instances) - np.count_nonzero(scores[a, b])
    return float(scores[a, b].sum() / len(objects)), float(scores[a, b].sum() / n_apart)


def smallest_gap(points: np.ndarray, truth: np.ndarray) -> float:
    """Metres between the two objects nearest to each other; infinity for a single one."""
    trees = [cKDTree(points[truth == one]) for one in np.unique(truth[truth > 0])]
    return min(
        (float(a.query(b.data)[0].min()) for i, a in enumerate(trees) for b in trees[i + 1 :]), default=float("inf")
    )


def main() -> None:
    """Print a line per scene, and the mean over those whose objects do not touch."""
    parser = argparse.ArgumentParser(description="Split F-score on organised clouds.")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--eps", type=float, default=ObjectsParams().eps, help="largest gap within an object, metres")
    options = parser.parse_args()
    files = sorted(options.folder.glob("*.pcd"))
    if not files:
        sys.exit(f"error: no *.pcd in {options.folder}")
    apart, touching = [], []
    print(f"{'scene':12} F-score  by part  strict  objects  found  smallest gap  seconds")
    for file in files:
        cloud = read_pcd(file)
        vertices, triangles = surface_of(cloud.points)
        label = cloud.label[np.isfinite(cloud.points).all(axis=2)].astype(np.int64)
        truth = np.where(label // PER_OBJECT >= FIRST_OBJECT, label // PER_OBJECT, 0)
        begun = time.perf_counter()
        view = PosedDepth(np.nan_to_num(cloud.points[..., 2]), K, np.eye(4))
        settings = SplitSettings(
            voxel_size=VOXEL_SIZE, guess_up=upward(np.eye(4)[None]), eps=options.eps, views=(view,), divide=True
        )
        split = split_objects(vertices, triangles, np.random.default_rng(0), settings)
        seconds = time.perf_counter() - begun
        found = split.vertex_instance[label > 0]
        score, strict = f_scores(truth[label > 0], found)
        by_part, _ = f_scores(np.where(truth > 0, label, 0)[label > 0], found)
        gap = smallest_gap(vertices, truth)
        (apart if gap > options.eps else touching).append((score, by_part, strict))
        n_objects = len(np.unique(truth[truth > 0]))
        print(
            f"{file.stem:12} {score:7.3f}  {by_part:7.3f}  {strict:6.3f}  {n_objects:7}  {len(split.instances):5}"
            f"  {100 * gap:9.2f} cm  {seconds:7.2f}"
            f"{'' if gap > options.eps else '  touch'}"
        )
    for name, scores in (("do not touch", apart), ("touch", touching)):
        means = np.mean(scores, axis=0).tolist() if scores else [float("nan")] * 3
        mean = "mean F-score {:.3f}, by part {:.3f}, strict {:.3f}".format(*means)
        print(f"{len(scores)} scenes whose objects {name} (eps {options.eps} m): {mean}")


if __name__ == "__main__":
    main()
