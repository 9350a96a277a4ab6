"""What the fast options of the tracker cost: `python benchmarks/tracker_trade.py ROOT --only lid_demo2,rubbish_demo2`.

ROOT holds a trained network and simulated demonstrations with ground truth. Sixteen keypoints, picked in a training
scan, are tracked with the default filter by one camera; each row is the mean error with an option, and its ratio to the
first row. The interval is a bootstrap over demonstrations, with the same draws for both. `bench_tracker.py` says what
the options gain.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from bask_data.core.filters.observation import Observation
from bask_data.core.keypoint_scores import Sighting, phases, sighting
from bask_data.dataset import Dataset
from bask_data.evaluation.study_tracks import references_of
from bask_data.evaluation.tracked_points import by_objects, points_to_track, true_tracks, whole
from bask_data.kinds import Demonstration, DescriptorNet, Pick
from bask_data.kinds.places import true_pixels
from bask_data.observing import FrameObservations, View, moment_of
from bask_data.stages.encode import grippers_of
from bask_data.tracker import KeypointTracker

SCALES, EVERY = (1.0, 0.75, 0.5), (1, 2, 3)
COLUMNS = ("all", "visible", "occluded", "out of view", "moving")
N_KEYPOINTS, N_DRAWS = 16, 2000
STANDING = ("saucepan",)
"""Objects without keypoints, as in `keypoints.py`."""


def main() -> None:
    parser = argparse.ArgumentParser(description="Error of the tracker's fast options.")
    parser.add_argument("root", type=Path)
    parser.add_argument("--only", required=True, help="demonstrations, separated by commas")
    parser.add_argument("--camera", default="wrist")
    parser.add_argument("--seeds", type=int, default=1)
    options = parser.parse_args()
    dataset = Dataset(options.root)
    names = options.only.split(",")
    errors: dict[str, dict[tuple[float, int], dict[str, np.ndarray]]] = {}
    for objects, mine in by_objects(dataset, names, ()).items():
        moved = tuple(one for one in objects if one not in STANDING)
        picks = points_to_track(dataset, moved, N_KEYPOINTS, "", 0)
        for name in mine:
            errors[name] = errors_in(dataset, name, picks, options.camera, range(options.seeds))
            print(f"tracked {name}", flush=True)
    print(table(errors))


def errors_in(
    dataset: Dataset, name: str, picks: list[Pick], camera_name: str, seeds: range
) -> dict[tuple[float, int], dict[str, np.ndarray]]:
    """By scale and `every`: errors, metres, by phase."""
    source = whole(dataset, name)
    assert source is not None
    demonstration = source.recording
    assert isinstance(demonstration, Demonstration)
    camera = demonstration.camera(camera_name)
    places = true_tracks(dataset, picks, name)[: camera.n_frames]
    pixels = [true_pixels(point, camera, source.truth, i) for i, point in enumerate(places)]
    inside, hidden = (np.array([[getattr(one, what) for one in pixels]]) for what in ("inside", "hidden"))
    seen: Sighting = sighting(inside, hidden, places)
    network = DescriptorNet(dataset.path(DescriptorNet)).network()
    grippers = grippers_of(demonstration, camera.n_frames)
    found: dict[tuple[float, int], list[np.ndarray]] = {}
    with TemporaryDirectory() as folder:
        reference = references_of(dataset, network, picks, Path(folder) / "reference")
        for scale in SCALES:
            trackers = {
                (every, seed): KeypointTracker(
                    network, reference, seed=seed, cameras=[camera_name], every=every, scale=scale
                )
                for every in EVERY
                for seed in seeds
            }
            means: dict[tuple[int, int], list[np.ndarray]] = {which: [] for which in trackers}
            for i_frame in range(camera.n_frames):
                look = next(iter(trackers.values())).look(*moment_of([camera], i_frame))
                gripper = None if grippers is None else grippers[i_frame]
                for (every, seed), tracker in trackers.items():
                    given = look if i_frame % every == 0 else undescribed(look)
                    means[every, seed].append(tracker.update(given, gripper).mean)
            for (every, _), track in means.items():
                found.setdefault((scale, every), []).append(np.linalg.norm(np.array(track) - places, axis=2))
    frames = {"all": seen.visible | seen.occluded | seen.out_of_view, **phases(places, seen)}
    frames["all"] = frames["all"] & ~frames["not seen yet"]
    return {
        which: {column: np.concatenate([error[frames[column]] for error in tracks]) for column in COLUMNS}
        for which, tracks in found.items()
    }


def undescribed(look: FrameObservations) -> FrameObservations:
    """The same frame without the network."""

    def view(seen: Observation) -> View:
        return View(seen.K, seen.world_from_camera)

    return replace(look, observations={}, between={name: view(seen) for name, seen in look.observations.items()})


def table(errors: dict[str, dict[tuple[float, int], dict[str, np.ndarray]]]) -> str:
    """Mean errors in mm, and their ratio to the whole image in every frame."""
    draws = np.random.default_rng(0).integers(len(errors), size=(N_DRAWS, len(errors)))
    lines = ["scale  every" + "".join(f"{column:>14}" for column in COLUMNS) + "   ratio of all (95 %)"]
    sums: dict[tuple[float, int], np.ndarray] = {}
    counts = np.array([np.nan_to_num(of[1.0, 1]["all"]).size for of in errors.values()])
    for which in next(iter(errors.values())):
        columns = {c: np.concatenate([of[which][c] for of in errors.values()]) for c in COLUMNS}
        sums[which] = np.array([np.nansum(of[which]["all"]) for of in errors.values()])
        both = [(sums[w][draws].sum(axis=1) / counts[draws].sum(axis=1)) for w in (which, (1.0, 1))]
        low, high = np.quantile(both[0] / both[1], (0.025, 0.975))
        ratio = sums[which].sum() / sums[1.0, 1].sum()
        shown = "".join(f"{1000 * np.nanmean(values):>14.1f}" for values in columns.values())
        lines.append(f"{which[0]:<7g}{which[1]:<5}{shown}   {ratio:.3f} ({low:.3f} to {high:.3f})")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
