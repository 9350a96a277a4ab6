"""Accuracy of tracked keypoints with a trained network: `python benchmarks/keypoints.py`.

The correspondence study of the paper (von Hartz et al. 2023, Sec. IV-A) on the tasks that `keypoint_sets.yaml` holds
out, which no setting was chosen on: of each task, five scans to train on, one to measure descriptors on, and twenty
demonstrations in which 16 keypoints are tracked, seen by the wrist camera alone. `ours` is the default of `bask-data
train` with larger crops, from closer views; `base` is the base DON with the same network, images and steps. Differences
of the methods' errors have 95 % intervals over resampled demonstrations; an order is claimed only where one excludes
zero. Some hours on two cores; `--stride 3` gives all methods every third frame only.

`--tuning` does the same on the tasks that settings were chosen on, with five demonstrations: to choose settings, not to
report them. The figures are drawn into the dataset's folder `figures`.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from accuracy import BUILD, STAGES, answer, bask_data
from descriptors import VARIANTS as NETWORKS
from keypoint_sets import Simulated, simulated

from bask_data.evaluation.study_comparisons import PRINTED, comparison_lines

N_SCANS = 6
N_DEMONSTRATIONS = {"keypoints": 20, "keypoints, tuning": 5}
VARIANTS = {"ours": ("--zoom", "0.6,2", "--crop-share", "0.75"), "base": NETWORKS["base"]}
# As near as the gripper comes, and every second scan of what the task leaves: a lid off its pan differs.
VIEWS = ("--cameras", "wrist,overhead", "--frames", "80", "--distance-spread", "0.6", "--finished", "0.5")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tuning", action="store_true", help="on the tasks that settings were chosen on")
    parser.add_argument("--root", type=Path, help="the dataset; what is up to date in it is not made again")
    parser.add_argument("--steps", type=int, default=5000, help="of each training")
    parser.add_argument("--stride", type=int, default=1, help="track in every so many-th frame")
    parser.add_argument("--json", type=Path, help="write the figures to this file, too")
    asked = parser.parse_args()
    if asked.tuning:
        table, tasks = "keypoints, tuning", simulated("keypoints, tuning")
    else:
        table, tasks = "keypoints", simulated("keypoints")
    root = asked.root or BUILD / table.replace(", ", "_")
    made(root, tasks, N_DEMONSTRATIONS[table])
    for name, options in VARIANTS.items():
        same = ("--steps", asked.steps, "--held-out", "0", "--best-by", "none")
        bask_data("train", root, "--variant", name, *same, *options)
    variants = ("--variant", ",".join(VARIANTS))
    found = answer(
        *("evaluate", "keypoints", root, *variants, "--cameras", "wrist", "--stride", asked.stride),
        *("--pictures", root / "figures"),
    )
    found["descriptors"] = answer("evaluate", "descriptor", root, *variants, "--no-sweep")["variants"]
    print_tables(found)
    print(f"\nfigures: {root / 'figures'}")
    if asked.json:
        asked.json.write_text(json.dumps(found, indent=2) + "\n")
    return 0


def made(root: Path, tasks: Simulated, n_demonstrations: int) -> None:
    """The dataset, as far as matches of the scans; the last scan of each task is not trained on."""
    for task in tasks.tasks:
        counts = ("--scans", N_SCANS, "--demonstrations", n_demonstrations, "--seed", tasks.seed)
        bask_data("ingest", "sim", root, "--task", task, *counts, *VIEWS)
    for stage in STAGES:
        bask_data(stage, root)
    bask_data("split", root, "--test", ",".join(f"{task}_scan{N_SCANS - 1}" for task in tasks.tasks))


def print_tables(found: Mapping[str, Any]) -> None:
    """Mean errors by method and phase, what may be claimed of their order, and the networks' matches."""
    for name, group in found["groups"].items():
        print(f"\n{name + ', mean error in mm':<40}" + "".join(f"{phase:>14}" for phase in (*PRINTED, "mean to mode")))
        for method, figures in group["methods"].items():
            means = [figures["error"][phase]["mean"] for phase in PRINTED] + [figures["apart"]["all"]["mean"]]
            print(f"{method:<40}" + "".join(f"{'-' if mean is None else f'{1000 * mean:.1f}':>14}" for mean in means))
        print(*comparison_lines(group["comparisons"]), sep="\n")
    print("\nall tasks", *comparison_lines(found["comparisons"]), sep="\n")
    matches = {name: of["all"]["pck_4"] for name, of in found["descriptors"].items()}
    print("\nPCK@4 % of held-out scans: " + ", ".join(f"{name} {share:.3f}" for name, share in matches.items()))


if __name__ == "__main__":
    sys.exit(main())
