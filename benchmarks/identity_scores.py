"""Precision and recall of `identify` over pairs of objects of different scans, on tasks and seeds not fitted on.

    python benchmarks/identity_scores.py                              4 tasks x 5 scans, seed 0, without clutter
    python benchmarks/identity_scores.py --seed 1 --clutter 3         another seed, three further objects on each table
    python benchmarks/identity_scores.py --shelves                    the two shipped shelves: lists what is matched

Every step is a command that a user could type; what is up to date under `build/identity` is not made again. An object
of the simulator is known by its task and its label; objects that touch count as the one that most pixels show.
"""

from __future__ import annotations

import argparse
import itertools
import shutil
import sys
from collections import Counter
from pathlib import Path

import numpy as np
from accuracy import HERE, REPOSITORY, bask_data

from bask_data.dataset import Dataset
from bask_data.kinds import Identities, ObjectInstances, Scan, Truth, VisibleMasks

BUILD = REPOSITORY / "build" / "identity"
TASKS = ("microwave", "lid", "phone", "rubbish")
PRECISION, RECALL = 0.98, 0.9
"""The least that is asked of the simulated scans."""
EVERY = 4
"""Frames of which one is compared with the labels."""

Place = tuple[str, int]
"""A scan, and the id of an object there."""


def simulated(seed: int, clutter: int, n_scans: int) -> Path:
    """A dataset of all tasks, small images."""
    root = BUILD / f"sim_{seed}_{clutter}_{n_scans}"
    size = ("--frames", "20", "--height", "160", "--width", "160")
    counts = ("--scans", str(n_scans), "--demonstrations", "0", "--seed", str(seed), "--clutter", str(clutter))
    for task in TASKS:
        bask_data("ingest", "sim", root, "--task", task, *counts, *size)
    return identified(root)


def shelves() -> Path:
    """Both shipped shelves with the workspaces of shelves.yaml."""
    root = BUILD / "shelves"
    for name in ("apc_shelf", "labelfusion_shelf"):
        bask_data("ingest", "apc", REPOSITORY / "datasets" / name, root, "--scene", name)
    shutil.copyfile(HERE / "shelves.yaml", root / "params.yaml")
    return identified(root)


def identified(root: Path) -> Path:
    for stage in ("reconstruct", "objects", "masks", "identify"):
        bask_data(stage, root)
    return root


def truth_of(dataset: Dataset) -> dict[Place, tuple[str, str] | None]:
    """Task and label of each object, by most pixels; None where no label lies on it."""
    found: dict[Place, tuple[str, str] | None] = {}
    for name in dataset.items("scene"):
        scan, truth = Scan(dataset.path(Scan, name)), Truth(dataset.path(Truth, name))
        masks, overlap = VisibleMasks(dataset.path(VisibleMasks, name)), Counter[tuple[int, int]]()
        for camera in scan.cameras:
            for i_frame in range(0, camera.n_frames, EVERY):
                both = masks.camera(camera.name).instance(i_frame), truth.instance(camera.name, i_frame)
                codes, counts = np.unique(256 * both[0].astype(int) + both[1], return_counts=True)
                overlap.update({divmod(int(code), 256): int(n) for code, n in zip(codes, counts, strict=True)})
        for row in ObjectInstances(dataset.path(ObjectInstances, name)).instances:
            labels = {label: n for (instance, label), n in overlap.items() if instance == row.id and label}
            group = name.rsplit("_", 1)[0] if "_scan" in name else ""
            best = max(labels, key=labels.__getitem__, default=0)
            found[name, row.id] = (group, truth.label_names[best]) if best else None
    return found


def scores(root: Path) -> tuple[int, int, int]:
    """Pairs of different scans that are rightly matched, wrongly matched and missed; wrong ones are printed."""
    dataset = Dataset(root)
    truth, of = truth_of(dataset), Identities(dataset.path(Identities)).of_instances()
    right = wrong = missed = 0
    for a, b in itertools.combinations(sorted(truth), 2):
        if a[0] == b[0]:
            continue
        same = truth[a] is not None and truth[a] == truth[b]
        matched = a in of and b in of and of[a].id == of[b].id
        right, wrong, missed = right + (same and matched), wrong + (matched and not same), missed + (same > matched)
        if matched and not same:
            print(f"  wrong: {a[0]}/{a[1]} ({truth[a]}) and {b[0]}/{b[1]} ({truth[b]})")
    return right, wrong, missed


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--clutter", type=int, default=0)
    parser.add_argument("--scans", type=int, default=5)
    parser.add_argument("--shelves", action="store_true")
    arguments = parser.parse_args()
    if arguments.shelves:
        root = shelves()
        truth, found = truth_of(Dataset(root)), Identities(Dataset(root).path(Identities))
        for row in found.identities:
            print([(truth[each.scene, each.instance], round(each.confidence, 3)) for each in row.members])
        print("unknown:", [truth[row.scene, row.instance] for row in found.metadata.unknown])
        return 0
    right, wrong, missed = scores(simulated(arguments.seed, arguments.clutter, arguments.scans))
    precision, recall = right / max(right + wrong, 1), right / max(right + missed, 1)
    print(f"precision {precision:.3f} ({right} of {right + wrong}), recall {recall:.3f} ({right} of {right + missed})")
    return 0 if precision >= PRECISION and recall >= RECALL else 1


if __name__ == "__main__":
    sys.exit(main())
