"""The particle filter with perfect descriptors, with alpha and tau as measured and without: `python
benchmarks/filters_measured.py [STEP ...]`.

As `filters.py`, by the wrist camera, with distance maps of every STEP-th pixel of images of 256x256: 1 and 4 by
default. `measured` takes alpha and tau from a scan of the same task, with the same descriptors, as `bask-data
reference` does. Ten minutes on two cores."""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace

import numpy as np
from accuracy import bask_data
from filters import N_DEMONSTRATIONS, ROOTS, Keypoints, Recorded, Track, figures, followed, picked, points_of, printed
from filters import recordings as demonstrations
from keypoint_sets import simulated

from bask_data.core.calibration import Calibration, calibrated
from bask_data.core.filters.calibrated import calibrated_settings
from bask_data.core.filters.observation import Observation, fitted
from bask_data.core.filters.table import settings_named
from bask_data.core.geometry import transform
from bask_data.core.rivals import measured_evidence
from bask_data.dataset import Dataset
from bask_data.kinds import Scan, Truth
from bask_data.kinds.places import object_poses
from bask_data.stages.keypoint_evidence import N_MEASURED_VIEWS, measured_frames

CAMERA, SEED = "wrist", 0
TABLE = "filters, tuning"
ROOT = ROOTS[TABLE]
SCANS = ROOT.with_name("filters_scans")


@dataclass(frozen=True)
class Coarse(Recorded):
    """A recording with distance maps of every `every`-th pixel, in the middle of its block."""

    every: int = 1

    def observation(self, camera: str, i_frame: int, keypoints: Keypoints) -> Observation:
        seen = super().observation(camera, i_frame, keypoints)
        middle = slice(self.every // 2, None, self.every)
        return fitted(replace(seen, distance=seen.distance[:, middle, middle]))


def measured(task: str, keypoints: Keypoints, every: int) -> Calibration | None:
    """alpha and tau of keypoints on the objects of a task, in a scan of it."""
    dataset = Dataset(SCANS)
    scan, truth = (kind(dataset.path(kind, f"{task}_scan0")) for kind in (Scan, Truth))
    recorded = Coarse(scan, truth, object_poses(truth), (CAMERA,), every)
    places = [transform(recorded.poses[label][0], point) for label, point in zip(*points_of(keypoints), strict=True)]
    views = [
        recorded.observation(camera.name, i, keypoints) for camera, i in measured_frames(scan.cameras, N_MEASURED_VIEWS)
    ]
    evidence = measured_evidence(np.stack(places), views, np.full(len(places), -1))
    return calibrated(evidence, len(places))


def main(arguments: list[str]) -> int:
    tasks = simulated(TABLE)
    for task in tasks.tasks:
        seed = ("--seed", tasks.seed)
        n = N_DEMONSTRATIONS // len(tasks.tasks)
        bask_data("ingest", "sim", ROOT, "--task", task, "--scans", 0, "--demonstrations", n, *seed)
        bask_data(
            "ingest", "sim", SCANS, "--task", task, "--scans", 1, "--demonstrations", 0, "--cameras", CAMERA, *seed
        )
    for every in [int(text) for text in arguments] or [1, 4]:
        tracks: dict[str, list[Track]] = {"measured": [], "not measured": []}
        for one in demonstrations(ROOT, [CAMERA], []):
            recorded = Coarse(one.demonstration, one.truth, one.poses, one.cameras, every)
            task = one.demonstration.path.name.split("_")[0]
            found = measured(task, picked(recorded, np.random.default_rng(SEED)), every)
            settings = {
                "measured": calibrated_settings("particle", found),
                "not measured": settings_named("particle"),
            }
            for name, track in followed(recorded, settings, SEED).items():
                tracks[name].append(track)
        print(f"\nevery {every}: cm, median / 90 %   " + "  ".join(figures(tracks["measured"])))
        for name, of in tracks.items():
            print(printed(f"particle, {name}", figures(of)))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
