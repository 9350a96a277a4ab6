"""Accuracy of the filters with perfect descriptors: `python benchmarks/filters.py`.

Object coordinates stand in for descriptors, so that only the filter is measured: the distance of a pixel to a keypoint
is twice the distance between the two on the object, in decimetres, and at most 2; 2 off the object. Eight
demonstrations of the simulated tasks that `keypoint_sets.yaml` holds out, or with `--tuning` of those that settings
were chosen on, seen by the wrist camera alone and by both cameras; and two identical boxes that differ only in their
position, of which one is seen before the other comes into view. Ten minutes on two cores.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from accuracy import BUILD, REPOSITORY, bask_data
from keypoint_sets import simulated

from bask_data.core.coverage import coverage
from bask_data.core.filters.observation import Motion, Observation
from bask_data.core.filters.step import step
from bask_data.core.filters.table import FILTERS, FilterSettings, settings_named
from bask_data.core.geometry import in_image, invert_rigid, pixel_grid, project, transform, unproject
from bask_data.dataset import Dataset
from bask_data.kinds import Demonstration, Truth
from bask_data.kinds.places import object_poses
from bask_data.progress import progress

ROOTS = {"filters": BUILD / "filters_held_out", "filters, tuning": BUILD / "filters"}
N_DEMONSTRATIONS, N_KEYPOINTS = 8, 16
REACH = 0.1
"""Metres from a keypoint from which on no descriptor is further from its own."""
APART = 2.0
"""Distance of descriptors from there on. Of trained networks, nine tenths of an image are further away."""
SEEN = 0.01
"""Metres: a camera sees a keypoint if the surface at its pixel is as near to it."""
STILL = 0.003
"""Metres: an object that has moved less stands still."""
BACK_WITHIN, LONG_OUT, REGAINED = 5, 50, 0.02
"""Frames after its return by which a keypoint must be right again; frames out of view that count as long; metres."""
COMPARED: dict[str, FilterSettings] = {
    **{name: settings_named(name) for name in reversed(FILTERS)},
    "particle as in the paper": settings_named("particle", "paper"),
    "particle as in its code": settings_named("particle", "code"),
    "discrete as in the paper": settings_named("discrete", "paper"),
}
ASKED = (("visible", 0.01), ("long_out", 0.02))
CALIBRATED = 0.05
"""Largest calibration error asked of the particle filter: mean |measured - nominal| share of ground truth in the
ellipsoids of the covariance, over nominal 5 to 95 % and all frames."""


@dataclass(frozen=True)
class Keypoints:
    """Points on objects.

    Attributes:
        labels: (k,) of each one's object.
        points_object: (k, 3), metres, frame of that object.
    """

    labels: np.ndarray
    points_object: np.ndarray


@dataclass(frozen=True)
class Recorded:
    """A demonstration and all that is known of it."""

    demonstration: Demonstration
    truth: Truth
    poses: dict[int, np.ndarray]
    cameras: tuple[str, ...]

    def coordinates(self, camera: str, i_frame: int) -> tuple[np.ndarray, np.ndarray]:
        """Label (h, w) of each pixel, and its place on that object (h, w, 3), metres, frame of the object."""
        depth, labels = self.truth.depth(camera, i_frame), self.truth.instance(camera, i_frame)
        K = self.demonstration.camera(camera).Ks[i_frame]
        world_from_camera = self.truth.world_from_cameras(camera)[i_frame]
        points = transform(world_from_camera, unproject(pixel_grid(*depth.shape), depth.astype(np.float64), K))
        for label, world_from_objects in self.poses.items():
            on_it = labels == label
            points[on_it] = transform(invert_rigid(world_from_objects[i_frame]), points[on_it])
        return np.where(depth > 0, labels, 0), points

    def observation(self, camera: str, i_frame: int, keypoints: Keypoints) -> Observation:
        """What the camera says of the keypoints, its recorded depth with its noise."""
        labels, points = self.coordinates(camera, i_frame)
        seen = self.demonstration.camera(camera)
        return Observation(
            distance=distances(labels, points, keypoints),
            depth=seen.depth(i_frame),
            K=seen.Ks[i_frame],
            world_from_camera=seen.world_from_cameras[i_frame],
        )

    def places(self, keypoints: Keypoints) -> np.ndarray:
        """Where the keypoints are (t, k, 3), metres, world frame."""
        n_frames = self.demonstration.cameras[0].n_frames
        return np.stack(
            [
                [transform(self.poses[label][i], point) for label, point in zip(*points_of(keypoints), strict=True)]
                for i in range(n_frames)
            ]
        )


def points_of(keypoints: Keypoints) -> tuple[list[int], list[np.ndarray]]:
    return keypoints.labels.tolist(), list(keypoints.points_object)


def distances(labels: np.ndarray, points: np.ndarray, keypoints: Keypoints) -> np.ndarray:
    """Distance maps (k, h, w) float32."""
    z = np.full((len(keypoints.labels), *labels.shape), APART, dtype=np.float32)
    for i, (label, point) in enumerate(zip(*points_of(keypoints), strict=True)):
        on_it = labels == label
        z[i, on_it] = APART * np.minimum(np.linalg.norm(points[on_it] - point, axis=-1) / REACH, 1.0)
    return z


def picked(recorded: Recorded, rng: np.random.Generator) -> Keypoints:
    """Random pixels of the first frames, as equally many of each object as can be."""
    shown = [recorded.coordinates(camera, 0) for camera in recorded.demonstration.camera_names]
    present = [label for label in recorded.poses if any((labels == label).sum() > 50 for labels, _ in shown)]
    labels, points = [], []
    for order, label in enumerate(present):
        n = N_KEYPOINTS // len(present) + (order < N_KEYPOINTS % len(present))
        on_it = np.concatenate([there[where == label] for where, there in shown])
        labels += [label] * n
        points.append(on_it[rng.choice(len(on_it), n, replace=False)])
    return Keypoints(np.array(labels), np.concatenate(points))


@dataclass(frozen=True)
class Track:
    """What a filter made of one demonstration. The last three are the same for all filters.

    Attributes:
        offset: (t, k, 3) ground truth seen from the estimate, metres.
        covariance: (t, k, 3, 3) of the estimate.
        is_seen: (t, k) whether a camera sees the keypoint, `in_view`: whether it is in the image of one.
        place: (t, k, 3) ground truth.
    """

    offset: np.ndarray
    covariance: np.ndarray
    is_seen: np.ndarray
    in_view: np.ndarray
    place: np.ndarray

    @property
    def error(self) -> np.ndarray:
        """(t, k) metres from ground truth."""
        return np.linalg.norm(self.offset, axis=-1)

    def phases(self) -> dict[str, np.ndarray]:
        """Errors by what was going on. What no camera has seen yet belongs to none."""
        known = np.maximum.accumulate(self.is_seen, axis=0)
        n_out, moved = frames_out(self.in_view), moved_since_seen(self)
        moves = np.linalg.norm(np.diff(self.place, axis=0, prepend=self.place[:1]), axis=-1) > 0.001
        masks = {
            "visible": self.is_seen,
            "moving": self.is_seen & moves,
            "hidden": known & self.in_view & ~self.is_seen & (moved < STILL),
            "out": known & ~self.in_view & (moved < STILL),
            "long_out": known & (n_out >= LONG_OUT) & (moved < STILL),
            "moved_unseen": known & ~self.is_seen & (moved >= STILL),
        }
        return {name: self.error[mask] for name, mask in masks.items()}

    def returns(self) -> list[bool]:
        """Of each return after at least `BACK_WITHIN` frames out of view: whether it was regained in time."""
        n_out, found = frames_out(self.in_view), []
        known = np.maximum.accumulate(self.is_seen, axis=0)
        for t, k in np.argwhere(self.is_seen[1:] & (n_out[:-1] >= BACK_WITHIN) & known[:-1]):
            after = slice(t + 1, t + 1 + BACK_WITHIN)
            if self.is_seen[after, k].sum() == BACK_WITHIN:
                found.append(bool((self.error[after, k] <= REGAINED).any()))
        return found


def frames_out(in_view: np.ndarray) -> np.ndarray:
    """For how many frames each keypoint has been out of all images (t, k)."""
    n = np.zeros(in_view.shape, dtype=int)
    for t in range(len(in_view)):
        n[t] = np.where(in_view[t], 0, (n[t - 1] if t else 0) + 1)
    return n


def moved_since_seen(track: Track) -> np.ndarray:
    """How far each keypoint is from where a camera last saw it (t, k), metres."""
    last, moved = track.place[0].copy(), np.zeros(track.is_seen.shape)
    for t in range(len(moved)):
        last = np.where(track.is_seen[t, :, None], track.place[t], last)
        moved[t] = np.linalg.norm(track.place[t] - last, axis=-1)
    return moved


def followed(recorded: Recorded, filters: dict[str, FilterSettings], seed: int) -> dict[str, Track]:
    """Each filter's track of a demonstration; frames are read once."""
    keypoints = picked(recorded, np.random.default_rng(seed))
    place = recorded.places(keypoints)
    robot = recorded.demonstration.robot
    grippers = robot.world_from_gripper if robot else None
    beliefs: dict[str, Any] = dict.fromkeys(filters)
    rngs = {name: np.random.default_rng(seed) for name in filters}
    offset: dict[str, list[np.ndarray]] = {name: [] for name in filters}
    covariance: dict[str, list[np.ndarray]] = {name: [] for name in filters}
    is_seen, in_view = np.zeros(place.shape[:2], dtype=bool), np.zeros(place.shape[:2], dtype=bool)
    for i in progress(range(len(place)), f"{recorded.demonstration.path.name}, {'+'.join(recorded.cameras)}"):
        observations = [recorded.observation(camera, i, keypoints) for camera in recorded.cameras]
        for seen in observations:
            inside, at_it = looked_at(seen, place[i])
            in_view[i] |= inside
            is_seen[i] |= inside & (at_it / APART * REACH < SEEN)
        motion = Motion(grippers[i - 1], grippers[i]) if grippers is not None and i else None
        for name, settings in filters.items():
            beliefs[name], estimate = step(beliefs[name], observations, motion, rngs[name], settings)
            offset[name].append(place[i] - estimate.mean)
            covariance[name].append(estimate.covariance)
    return {
        name: Track(np.stack(offset[name]), np.stack(covariance[name]), is_seen, in_view, place) for name in filters
    }


def looked_at(seen: Observation, points_world: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Whether each keypoint is in the image, and the distance map's value at its pixel."""
    height, width = seen.depth.shape
    uv, _ = project(transform(invert_rigid(seen.world_from_camera), points_world), seen.K)
    inside = in_image(uv, height, width)
    u, v = np.rint(np.where(inside[:, None], uv, 0)).astype(int).clip(0, [width - 1, height - 1]).T
    return inside, seen.distance[np.arange(len(uv)), v, u]


# Twins ---------------------------------------------------------------------------------------------------------------


def twins(seed: int) -> Iterator[tuple[list[Observation], np.ndarray]]:
    """Two equal boxes: one is seen by itself, then both, then only its twin, then both; and the keypoints (k, 3)."""
    sys.path.insert(0, str(REPOSITORY))
    from tests.scenes import Box, Scene, intrinsics, look_at

    rng = np.random.default_rng(seed)
    centres = np.array([[-0.13, 0.0, 0.03], [0.13, 0.0, 0.03]]) + rng.uniform(-0.03, 0.03, (2, 3)) * [1, 1, 0]
    boxes = [Box((0.03, 0.03, 0.03), _turned(centre, rng.uniform(0, 2 * np.pi))) for centre in centres]
    scene = Scene(tuple(boxes))
    points = np.concatenate([rng.uniform(-0.03, 0.03, (8, 2)), np.full((8, 1), 0.03)], axis=1)
    keypoints = Keypoints(np.ones(8, dtype=int), points)
    K = intrinsics(128, 128)
    first, second = (np.append(centre[:2], 0.0) for centre in centres)
    stops = [first + (first - second) * 0.25, (first + second) / 2, second + (second - first) * 0.25]
    path = [stops[0]] * 10 + [*_between(stops[0], stops[1], 15)] + [stops[1]] * 10 + [*_between(stops[1], stops[2], 15)]
    path += [stops[2]] * 10 + [*_between(stops[2], stops[1], 15)] + [stops[1]] * 10
    for i, target in enumerate(path):
        height = 0.30 + 0.15 * np.sin(i / 85 * np.pi)
        world_from_camera = look_at(target + np.array([0.02 * np.sin(i / 7), -0.15, height]), target)
        view = scene.render(K, world_from_camera, 128, 128)
        grid = transform(world_from_camera, unproject(pixel_grid(128, 128), view.depth, K))
        coordinates = np.full(grid.shape, 9.0)
        for label, box in enumerate(boxes, start=1):
            on_it = view.instance == label
            coordinates[on_it] = box.local(grid[on_it])
        labels = np.isin(view.instance, (1, 2)).astype(int)
        noisy = view.depth * (1 + 0.005 * rng.standard_normal(view.depth.shape))
        seen = Observation(distances(labels, coordinates, keypoints), noisy.astype(np.float32), K, world_from_camera)
        yield [seen], transform(boxes[0].world_from_box, points)


def _turned(centre: np.ndarray, angle: float) -> np.ndarray:
    world_from_box = np.eye(4)
    c, s = np.cos(angle), np.sin(angle)
    world_from_box[:3] = np.array([[c, -s, 0, centre[0]], [s, c, 0, centre[1]], [0, 0, 1, centre[2]]])
    return world_from_box


def _between(start: np.ndarray, end: np.ndarray, n: int) -> Iterator[np.ndarray]:
    return (start + (end - start) * share for share in np.linspace(0, 1, n, endpoint=False))


def not_confused(filters: dict[str, FilterSettings], n_seeds: int) -> dict[str, float]:
    """Share of the keypoints that end within 5 cm of ground truth; their twins are 20 cm away."""
    right: dict[str, list[bool]] = {name: [] for name in filters}
    for seed in progress(range(n_seeds), "twins"):
        beliefs: dict[str, Any] = dict.fromkeys(filters)
        rngs = {name: np.random.default_rng(seed) for name in filters}
        for observations, truth in twins(seed):
            for name, settings in filters.items():
                beliefs[name], estimate = step(beliefs[name], observations, None, rngs[name], settings)
                last = np.linalg.norm(estimate.mean - truth, axis=-1)
                right[name] = [*right[name][: 8 * seed], *(last < 0.05)]
    return {name: float(np.mean(values)) for name, values in right.items()}


# Tables --------------------------------------------------------------------------------------------------------------


def recordings(root: Path, cameras: Sequence[str], only: Sequence[str]) -> Iterator[Recorded]:
    """All demonstrations of the dataset."""
    dataset = Dataset(root)
    for name in dataset.items("demonstration"):
        if not only or name in only:
            truth = Truth(dataset.path(Truth, name))
            yield Recorded(Demonstration(dataset.path(Demonstration, name)), truth, object_poses(truth), tuple(cameras))


def figures(tracks: Sequence[Track]) -> dict[str, Any]:
    """Median and 90th percentile of the errors by phase, metres, the share of the returns that were regained, and the
    calibration error of the covariance."""
    phases: dict[str, Any] = {}
    for name in tracks[0].phases():
        errors = np.concatenate([track.phases()[name] for track in tracks])
        errors = errors[np.isfinite(errors)]
        phases[name] = (
            [float(np.median(errors)), float(np.percentile(errors, 90)), len(errors)] if len(errors) else None
        )
    returns = [regained for track in tracks for regained in track.returns()]
    certainty = coverage(
        np.concatenate([track.offset.reshape(-1, 3) for track in tracks]),
        np.concatenate([track.covariance.reshape(-1, 3, 3) for track in tracks]),
    )
    return {
        **phases,
        "regained": [float(np.mean(returns)), len(returns)] if returns else None,
        "calibration": [certainty.error, certainty.n],
    }


def printed(name: str, found: dict[str, Any]) -> str:
    cells = [
        "-"
        if value is None
        else f"{100 * value[0]:.1f} / {100 * value[1]:.1f}"
        if len(value) == 3
        else f"{value[0]:.3f}"
        for value in found.values()
    ]
    return f"{name:<28}" + "".join(f"{cell:>15}" for cell in cells)


def main(arguments: list[str]) -> int:
    """Make the recordings, follow them, print."""
    parser = argparse.ArgumentParser(description="How right the filters are when descriptors are.")
    parser.add_argument("--root", type=Path, help="another dataset with simulated demonstrations")
    parser.add_argument("--tuning", action="store_true", help="demonstrations that settings were chosen on")
    parser.add_argument("--only", default="", help="demonstrations, by commas; all by default")
    parser.add_argument("--filters", default=",".join(COMPARED), help="by commas")
    parser.add_argument("--cameras", default="wrist,wrist+overhead", help="sets of cameras, by commas")
    parser.add_argument("--twins", type=int, default=25, help="scenes with two equal boxes; eight keypoints each")
    parser.add_argument("--json", type=Path, help="write the figures to this file, too")
    options = parser.parse_args(arguments)
    filters = {name: COMPARED[name] for name in options.filters.split(",")}
    tasks = simulated("filters, tuning") if options.tuning else simulated("filters")
    root = options.root or ROOTS["filters, tuning" if options.tuning else "filters"]
    for task in () if options.root else tasks.tasks:
        counts = ("--scans", 0, "--demonstrations", N_DEMONSTRATIONS // len(tasks.tasks), "--seed", tasks.seed)
        bask_data("ingest", "sim", root, "--task", task, *counts)
    only = [name for name in options.only.split(",") if name]
    table: dict[str, Any] = {}
    for cameras in options.cameras.split(","):
        followed_by = [followed(one, filters, 0) for one in recordings(root, cameras.split("+"), only)]
        found = {name: figures([tracks[name] for tracks in followed_by]) for name in filters}
        print(
            f"\n{cameras + ', cm, median / 90 %':<28}" + "".join(f"{name:>15}" for name in found[next(iter(filters))])
        )
        for name in filters:
            print(printed(name, found[name]))
        table[cameras] = found
    table["identical objects distinguished"] = not_confused(filters, options.twins) if options.twins else {}
    for name, share in table["identical objects distinguished"].items():
        print(f"identical objects distinguished by {name}: {share:.3f}")
    if options.json:
        options.json.write_text(json.dumps(table, indent=2) + "\n")
    return 0 if "particle" not in filters or all(verdicts(table)) else 1


def verdicts(table: dict[str, Any]) -> Iterator[bool]:
    """Whether the particle filter is as good as is asked of it."""
    for cameras, found in table.items():
        if cameras == "identical objects distinguished":
            checks = [(cameras, found["particle"] >= 0.95)] if found else []
        else:
            of = found["particle"]
            checks = [
                (f"{cameras} {name}: median <= {most:g} m", of[name][0] <= most) for name, most in ASKED if of[name]
            ]
            checks += [(f"{cameras} regained >= 0.95", of["regained"][0] >= 0.95)] if of["regained"] else []
            checks.append((f"{cameras} calibration <= {CALIBRATED:g}", of["calibration"][0] <= CALIBRATED))
        for name, holds in checks:
            print(f"asked of particle, {name}: {'holds' if holds else 'MISSED'}")
            yield holds


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
