"""Accuracy of tracked keypoints with a trained network: `python benchmarks/keypoints.py`.

The correspondence study of the paper (von Hartz et al. 2023, Sec. IV-A) on two simulated tasks, with the lid of a
saucepan and with rubbish: five scans of each to train on, five demonstrations in which 16 keypoints are tracked, seen
by the wrist camera alone. `ours` is the default of `bask-data train` with larger crops, from closer views; `base` is
the base DON with the same network, images and steps. Three quarters of an hour on two cores. The figures are drawn
into build/accuracy/keypoints/figures.
"""

from __future__ import annotations

import sys

from accuracy import BUILD, STAGES, answer, bask_data
from descriptors import VARIANTS as NETWORKS

ROOT = BUILD / "keypoints"
TASKS, N_SCANS = ("lid", "rubbish"), 6
SAME = ("--steps", "5000", "--held-out", "0", "--best-by", "none")
VARIANTS = {"ours": ("--zoom", "0.6,2", "--crop-share", "0.75"), "base": NETWORKS["base"]}
PHASES = ("all", "visible", "occluded", "out of view")


def main() -> int:
    for task in TASKS:
        # As near as the gripper comes, and every second scan of what the task leaves: a lid off its pan differs.
        views = ("--cameras", "wrist,overhead", "--frames", "80", "--distance-spread", "0.6", "--finished", "0.5")
        bask_data("ingest", "sim", ROOT, "--task", task, "--scans", N_SCANS, "--demonstrations", 5, *views)
    for stage in STAGES:
        bask_data(stage, ROOT)
    bask_data("split", ROOT, "--test", ",".join(f"{task}_scan{N_SCANS - 1}" for task in TASKS))
    for name, options in VARIANTS.items():
        bask_data("train", ROOT, "--variant", name, *SAME, *options)
    asked = ("--objects", "lid,bin,rubbish", "--cameras", "wrist", "--pictures", ROOT / "figures")
    groups = answer("evaluate", "keypoints", ROOT, "--variant", ",".join(VARIANTS), *asked)["groups"]
    for name, group in groups.items():
        print(f"\n{name + ', mean error in mm':<40}" + "".join(f"{phase:>14}" for phase in (*PHASES, "mean to mode")))
        for method, found in group["methods"].items():
            means = [found["error"][phase]["mean"] for phase in PHASES] + [found["apart"]["all"]["mean"]]
            print(f"{method:<40}" + "".join(f"{1000 * mean:>14.1f}" for mean in means))
    print(f"\nfigures: {ROOT / 'figures'}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
