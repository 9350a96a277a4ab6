"""The points that a study of keypoints tracks, and their ground truth in each demonstration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

from bask_data.artifact import MANIFEST
from bask_data.dataset import Dataset
from bask_data.errors import UsageError
from bask_data.evaluation.held_out import learned_scenes
from bask_data.evaluation.places import known, known_of
from bask_data.kinds import Camera, Pick, Recording, ReferenceKeypoints, Truth
from bask_data.kinds.places import Known, ObjectPoints, carried, label_of, object_poses, points_on_objects
from bask_data.kinds.truth import ROBOT

if TYPE_CHECKING:
    import numpy as np

ROUND = ("lid",)
"""Objects that are symmetric about their own z axis: the simulator's only one."""
TRACKED_BORDERS = (0.015, 0.0)
"""Distances of points from an object's edge, as shares of the image's height; slim objects take the next."""
N_LOOKED_AT = 24
"""Frames of each camera that are searched for the one that shows most of the objects."""
N_POINT_CANDIDATES = 400
"""Pixels of an object that its points are chosen from."""


def demonstrations_with_truth(dataset: Dataset, asked: Sequence[str]) -> list[str]:
    """Demonstrations with ground-truth poses of their objects: those asked for, or all.

    Raises:
        UsageError: there are none, or one asked for is not among them.
    """
    existing = dataset.items("demonstration")
    known_to_truth = [name for name in existing if (source := whole(dataset, name)) and _objects_of(source.truth)]
    for name in asked:
        if name not in known_to_truth:
            got = "none of that name" if name not in existing else f"{name}, without"
            raise UsageError(
                dataset.root,
                "--demonstrations",
                expected=f"one with ground-truth transforms ({', '.join(known_to_truth) or 'there is none'})",
                got=got,
            )
    if not known_to_truth:
        raise UsageError(
            dataset.root,
            "",
            expected="a demonstration with ground-truth poses of its objects",
            got="none",
            # Not into this dataset, which may be of real recordings.
            fix="evaluate another dataset; `bask-data ingest sim OTHER_ROOT --task lid` makes one with ground truth.",
        )
    return list(dict.fromkeys(asked)) or known_to_truth


def by_objects(
    dataset: Dataset, demonstrations: Sequence[str], wanted: Sequence[str]
) -> dict[tuple[str, ...], list[str]]:
    """Demonstrations by the objects that are tracked in them: all of theirs, or those wanted.

    Raises:
        UsageError: a wanted object is in none of them.
    """
    groups: dict[tuple[str, ...], list[str]] = {}
    existing: set[str] = set()
    for name in demonstrations:
        source = whole(dataset, name)
        objects = _objects_of(source.truth) if source else ()
        existing.update(objects)
        tracked = tuple(body for body in objects if body in wanted or not wanted)
        if tracked:
            groups.setdefault(tracked, []).append(name)
    unknown = [body for body in wanted if body not in existing]
    if unknown:
        expected = f"one of the objects {', '.join(sorted(existing))}"
        raise UsageError(dataset.root, "--objects", expected=expected, got=", ".join(unknown))
    return groups


class Whole(NamedTuple):
    """A recording and its ground truth, including exact depth and cameras."""

    recording: Recording
    truth: Truth


def whole(dataset: Dataset, name: str) -> Whole | None:
    """A recording with exact ground truth; None if frames or ground truth are missing."""
    source = known(dataset, name)
    if source is None or source.recording is None or source.truth is None or not source.truth.has_depth:
        return None
    return Whole(source.recording, source.truth)


def _objects_of(truth: Truth) -> tuple[str, ...]:
    """Names of the objects with ground-truth transforms, in the order of their labels."""
    names = truth.label_names
    return tuple(names[label] for label in sorted(object_poses(truth)) if label in names and label != ROBOT)


# Choosing ------------------------------------------------------------------------------------------------------------


def points_to_track(
    dataset: Dataset,
    objects: Sequence[str],
    n: int,
    reference: str,
    seed: int,
    pick_in: Sequence[str] = (),
    cameras: Sequence[str] = (),
) -> list[Pick]:
    """Points on these objects: the picks of a variant of `reference`, or else n of one frame, shared equally among the
    objects and spread over each.

    Args:
        pick_in: recordings, of which the first that shows all of the objects is used; by default the training scans.
        cameras: to pick in, if the recording has any of them; by default all.

    Raises:
        UsageError: no pick of the variant is on the objects, no recording shows them, or one does not exist.
    """
    if reference:
        return _picks_of(dataset, reference, objects)
    best: tuple[float, Whole, Camera, int] | None = None
    for name in pick_in:
        if name not in dataset.items("recording"):
            known_names = ", ".join(dataset.items("recording"))
            raise UsageError(dataset.root, "--pick-in", expected=f"one of {known_names}", got=name)
    for recording in pick_in or learned_scenes(dataset):
        one = whole(dataset, recording)
        if one is None or not {*objects} <= {*_objects_of(one.truth)}:
            continue
        labels = [label_of(one.truth, name, -1) for name in objects]
        there = one.recording.cameras
        for camera in [camera for camera in there if camera.name in cameras] or there:
            for i in range(0, camera.n_frames, max(camera.n_frames // N_LOOKED_AT, 1)):
                n_least = _n_of_the_smallest(one.truth, camera, i, labels)
                if best is None or n_least > best[0]:
                    best = n_least, one, camera, i
        if best is not None and best[0] > 0:
            break  # One recording is enough: a person would pick in one frame, too.
    if best is None or best[0] == 0:
        raise UsageError(
            dataset.root,
            "",
            expected=f"a frame with ground truth that shows {', '.join(objects)}, to pick keypoints in",
            got=f"none in {', '.join(pick_in) or 'the training scans'}",
            fix="choose another recording with --pick-in NAME, or your own picks with --reference VARIANT.",
        )
    return _spread_picks(objects, *best[1:], n, seed)


def _picks_of(dataset: Dataset, variant: str, objects: Sequence[str]) -> list[Pick]:
    path = dataset.path(ReferenceKeypoints, variant=variant)
    if variant not in dataset.variants(ReferenceKeypoints) or not (path / MANIFEST).exists():
        there = ", ".join(dataset.variants(ReferenceKeypoints))
        raise UsageError(dataset.root, "--reference", expected=f"one of {there}, made", got=variant)
    picks = ReferenceKeypoints(path).picks
    on = points_on_objects(picks, known_of(dataset, picks)).names
    mine = [pick for pick, name in zip(picks, on, strict=True) if name in objects and whole(dataset, pick.recording)]
    if not mine:
        fix = "leave out the demonstrations of other objects, with --demonstrations, or pick on these."
        raise UsageError(dataset.root, "--reference", expected=f"picks on {', '.join(objects)}", got="none", fix=fix)
    return mine


def _n_of_the_smallest(truth: Truth, camera: Camera, i_frame: int, labels: Sequence[int]) -> float:
    """Pixels of the object with the fewest pixels in a frame."""
    import numpy as np

    return float(np.bincount(truth.instance(camera.name, i_frame).ravel(), minlength=256)[list(labels)].min())


def _spread_picks(objects: Sequence[str], one: Whole, camera: Camera, i_frame: int, n: int, seed: int) -> list[Pick]:
    import numpy as np

    from bask_data.nn.selection import inner_pixels, spread_out

    labels, depth = one.truth.instance(camera.name, i_frame), one.truth.depth(camera.name, i_frame)
    picks = []
    for order, name in enumerate(objects):
        wanted = n // len(objects) + (order < n % len(objects))
        mask, uv = labels == label_of(one.truth, name, -1), np.zeros((0, 2))
        for border in TRACKED_BORDERS:
            if len(uv) < wanted:
                rng = np.random.default_rng([seed, order])
                uv = inner_pixels(mask, depth, border * camera.height, N_POINT_CANDIDATES, rng)
        if not wanted or not len(uv):
            continue
        column, row = uv.astype(int).T
        points = camera.points_world(i_frame, uv, depth[row, column])
        for i, chosen in enumerate(spread_out(points, np.zeros(len(uv)), min(wanted, len(uv)))):
            u, v = uv[chosen].tolist()
            x, y, z = points[chosen].tolist()
            where = {"recording": one.recording.path.name, "camera": camera.name, "frame": i_frame, "u": u, "v": v}
            picks.append(Pick(name=f"{name}_{i}", point_world=(x, y, z), **where))
    return picks


# Ground truth --------------------------------------------------------------------------------------------------------


def true_tracks(dataset: Dataset, picks: Sequence[Pick], demonstration: str) -> np.ndarray:
    """Ground truth of picked points in each frame of a demonstration (t, k, 3), metres, world frame; NaN where unknown.

    The pose of a round object does not determine its points. They are taken at the same position relative to what the
    object touches in the first frames of both recordings.
    """
    recordings, here = known_of(dataset, picks, demonstration), whole(dataset, demonstration)
    assert here is not None, "only demonstrations with ground truth are studied"
    points = points_on_objects(picks, recordings)
    points = _turned_with_neighbours(points, picks, recordings, here.truth)
    return carried(points, here.truth, max(camera.n_frames for camera in here.recording.cameras))


def _turned_with_neighbours(
    points: ObjectPoints, picks: Sequence[Pick], recordings: dict[str, Known], here: Truth
) -> ObjectPoints:
    from bask_data.core.geometry import invert_rigid, transform

    placed, poses_here = points.points_object.copy(), object_poses(here)
    for i, (pick, label, name) in enumerate(zip(picks, points.labels, points.names, strict=True)):
        there = recordings[pick.recording].truth if name in ROUND else None
        if there is None or there is here:
            continue
        neighbour, mine_here = _touched(there, label), label_of(here, name, label)
        neighbour_here = label_of(here, there.label_names.get(neighbour, ""), neighbour)
        if neighbour_here not in poses_here or mine_here not in poses_here:
            continue
        poses = object_poses(there)
        # From the first frames, whatever has moved the object by the frame of the pick.
        neighbour_from_mine = invert_rigid(poses[neighbour][0]) @ poses[label][0]
        mine_from_neighbour = invert_rigid(poses_here[mine_here][0]) @ poses_here[neighbour_here][0]
        placed[i] = transform(mine_from_neighbour @ neighbour_from_mine, placed[i])
    return replace(points, points_object=placed)


def _touched(truth: Truth, label: int) -> int:
    """The label of the first object that touches this one; -1 without any."""
    others = [b if a == label else a for a, b in truth.touching if label in (a, b)]
    known_to_truth = object_poses(truth)
    return next((other for other in others if other in known_to_truth), -1)
