"""Which points a study of keypoints follows, and where they truly are in each demonstration."""

from __future__ import annotations

import shlex
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
"""Objects that look the same however they are turned about their own z axis: the simulator's one."""
TRACKED_BORDERS = (0.015, 0.0)
"""Distances of points from an object's edge, as shares of the image's height; the next where it is slim."""
N_LOOKED_AT = 24
"""Frames of each camera of a scan among which the one that shows most of the objects is looked for."""
N_POINT_CANDIDATES = 400
"""Pixels of an object that its points are chosen from."""


def demonstrations_with_truth(dataset: Dataset, asked: Sequence[str]) -> list[str]:
    """Demonstrations whose truth knows where their objects are: those asked for, or all.

    Raises:
        UsageError: there is none, or one asked for is not.
    """
    there = dataset.items("demonstration")
    known_to_truth = [name for name in there if (one := whole(dataset, name)) and _objects_of(one.truth)]
    for name in asked:
        if name not in known_to_truth:
            got = "none of that name" if name not in there else f"{name}, without"
            raise UsageError(
                dataset.root,
                "--demonstrations",
                expected=f"of those with true transforms ({', '.join(known_to_truth) or 'there is none'})",
                got=got,
            )
    if not known_to_truth:
        raise UsageError(
            dataset.root,
            "",
            expected="a demonstration whose truth knows where the objects are",
            got="none",
            fix=f"bask-data ingest sim {shlex.quote(str(dataset.root))} --task lid --scans 0 --demonstrations 5",
        )
    return list(dict.fromkeys(asked)) or known_to_truth


def by_objects(
    dataset: Dataset, demonstrations: Sequence[str], wanted: Sequence[str]
) -> dict[tuple[str, ...], list[str]]:
    """Demonstrations by the objects that are tracked in them: all they have, or those wanted.

    Raises:
        UsageError: one that is wanted is in none of them.
    """
    found: dict[tuple[str, ...], list[str]] = {}
    there: set[str] = set()
    for name in demonstrations:
        one = whole(dataset, name)
        objects = _objects_of(one.truth) if one else ()
        there.update(objects)
        mine = tuple(body for body in objects if body in wanted or not wanted)
        if mine:
            found.setdefault(mine, []).append(name)
    unknown = [one for one in wanted if one not in there]
    if unknown:
        expected = f"of the objects {', '.join(sorted(there))}"
        raise UsageError(dataset.root, "--objects", expected=expected, got=", ".join(unknown))
    return found


class Whole(NamedTuple):
    """A recording and its truth, exact depth and cameras included."""

    recording: Recording
    truth: Truth


def whole(dataset: Dataset, name: str) -> Whole | None:
    """A recording with all there is to know of it; None where frames or truth are missing."""
    one = known(dataset, name)
    if one is None or one.recording is None or one.truth is None or not one.truth.has_depth:
        return None
    return Whole(one.recording, one.truth)


def _objects_of(truth: Truth) -> tuple[str, ...]:
    """Names of the objects whose transforms truth knows, by label."""
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
    """Points on these objects: the picks of a variant of `reference`, or else n of one frame, as equally many on each
    object as can be and spread over it.

    Args:
        pick_in: recordings, the first of which that shows all of the objects is picked in; by default scans that
            networks learn from.
        cameras: that are picked in, where the recording has one of them; by default all.

    Raises:
        UsageError: no pick of the variant is on the objects, no recording shows them, or is there.
    """
    if reference:
        return _picks_of(dataset, reference, objects)
    best: tuple[float, Whole, Camera, int] | None = None
    for name in pick_in:
        if name not in dataset.items("recording"):
            known_names = ", ".join(dataset.items("recording"))
            raise UsageError(dataset.root, "--pick-in", expected=f"of {known_names}", got=name)
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
            break  # One recording is enough, and a frame of it is what somebody would pick in.
    if best is None or best[0] == 0:
        raise UsageError(
            dataset.root,
            "",
            expected=f"a frame with truth that shows {', '.join(objects)}, to pick keypoints in",
            got=f"none in {', '.join(pick_in) or 'the scans that networks learn from'}",
            fix="name another recording, --pick-in NAME, or give picks of your own, --reference VARIANT.",
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
        raise UsageError(dataset.root, "--reference", expected=f"picks on {', '.join(objects)}", got="none")
    return mine


def _n_of_the_smallest(truth: Truth, camera: Camera, i_frame: int, labels: Sequence[int]) -> float:
    """Pixels of the object that a frame shows least of."""
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
            scan = one.recording.path.name
            picks.append(Pick(name=f"{name}_{i}", recording=scan, camera=camera.name, frame=i_frame, u=u, v=v))
    return picks


# Truth ---------------------------------------------------------------------------------------------------------------


def true_tracks(dataset: Dataset, picks: Sequence[Pick], demonstration: str) -> np.ndarray:
    """Where picked points are in each frame of a demonstration (t, k, 3), metres, world; NaN where that is not known.

    A point of a round object cannot be told by the object alone. Which of its points is meant is said by what the
    object touches in the first frames of both recordings: the one at the same place of that.
    """
    recordings, here = known_of(dataset, picks, demonstration), whole(dataset, demonstration)
    assert here is not None, "asked only where there is truth"
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
        # Wherever it has been carried by the frame of the pick.
        neighbour_from_mine = invert_rigid(poses[neighbour][0]) @ poses[label][0]
        mine_from_neighbour = invert_rigid(poses_here[mine_here][0]) @ poses_here[neighbour_here][0]
        placed[i] = transform(mine_from_neighbour @ neighbour_from_mine, placed[i])
    return replace(points, points_object=placed)


def _touched(truth: Truth, label: int) -> int:
    """The first object that one touches; -1 without any."""
    others = [b if a == label else a for a, b in truth.touching if label in (a, b)]
    known_to_truth = object_poses(truth)
    return next((other for other in others if other in known_to_truth), -1)
