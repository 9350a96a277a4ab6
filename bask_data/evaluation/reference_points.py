"""Reference points: where they were picked, and where they truly are in other views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from bask_data.dataset import Dataset
from bask_data.evaluation.held_out import learned_scenes
from bask_data.evaluation.lookup import find, find_recording, find_truth, spread_frames
from bask_data.evaluation.places import known_of
from bask_data.kinds import Camera, Pick, ReferenceKeypoints, Scan, VisibleMasks
from bask_data.kinds.places import label_of, picked_label, points_on_objects, true_pixels, true_places

N_POINTS = 16
"""Points chosen where no reference keypoints are there."""
N_LOOKED_AT = 24
"""Frames of a scene among which the one with most to pick from is looked for."""
INNER_BORDERS = (0.03, 0.015, 0.0)
"""Distances of such points from a mask's edge, as shares of the image's height; the next where an object is slim."""
SEEN, BEHIND, OUTSIDE, UNKNOWN = "seen", "hidden", "out of view", "unknown"


def reference_points(dataset: Dataset, variants: Sequence[str]) -> list[Pick]:
    """The picks of the first of these variants that has reference keypoints, or else some well inside the objects of
    one frame of a training scene, of each set of objects that occurs together: all networks are asked for the same."""
    for variant in variants:
        found = find(dataset, ReferenceKeypoints, "", variant)
        if found is not None and found.picks:
            return found.picks
    scene_of: dict[frozenset[str], tuple[Scan, VisibleMasks]] = {}
    for name in learned_scenes(dataset):
        scan, masks, truth = find(dataset, Scan, name), find(dataset, VisibleMasks, name), find_truth(dataset, name)
        if scan is not None and masks is not None and masks.n_instances:
            # Without labels nobody knows which scenes show the same.
            scene_of.setdefault(frozenset(truth.label_names.values() if truth else ()), (scan, masks))
    return [pick for scan, masks in scene_of.values() for pick in _inner_points(dataset, scan, masks)]


def _inner_points(dataset: Dataset, scan: Scan, masks: VisibleMasks) -> list[Pick]:
    """Points of the frame that shows most of all objects, spread over each of them."""
    from bask_data.nn.selection import inner_pixels, spread_out

    camera, i_frame = _fullest_frame(scan, masks)
    depth, instance = camera.depth(i_frame), masks.camera(camera.name).instance(i_frame)
    shown = [int(i) for i in np.unique(instance) if i]
    picks = []
    for order, i in enumerate(shown):
        n = N_POINTS // len(shown) + (order < N_POINTS % len(shown))
        uv, rng = np.zeros((0, 2)), np.random.default_rng(i)
        for border in INNER_BORDERS:
            if len(uv) < n:
                uv = inner_pixels(instance == i, depth, border * camera.height, depth.size, rng)
        if not len(uv) or not n:
            continue
        column, row = uv.astype(int).T
        points = camera.points_world(i_frame, uv, depth[row, column])
        for row in spread_out(points, np.zeros(len(uv)), min(n, len(uv))):
            (u, v), (x, y, z) = uv[row].tolist(), points[row].tolist()
            where = {"recording": scan.path.name, "camera": camera.name, "frame": i_frame, "u": u, "v": v}
            picks.append(Pick(name=f"object_{i}", instance=i, point_world=(x, y, z), **where))
    return [pick.model_copy(update={"name": _object_name(dataset, pick)}) for pick in picks]


def _object_name(dataset: Dataset, pick: Pick) -> str:
    """The label's where there is one, else the instance's number."""
    truth = find_truth(dataset, pick.recording)
    label = picked_label(pick, truth)
    return truth.label_names.get(label, pick.name) if truth and label > 0 else pick.name


def _fullest_frame(scan: Scan, masks: VisibleMasks) -> tuple[Camera, int]:
    """A large object must not outweigh a small one: their sizes count by the length of their sides."""
    best = (-1.0, scan.cameras[0], 0)
    for camera in scan.cameras:
        for i_frame in spread_frames(camera.n_frames, N_LOOKED_AT):
            sizes = np.bincount(masks.camera(camera.name).instance(i_frame).ravel(), minlength=2)[1:]
            best = max(best, (float(np.sqrt(sizes).sum()), camera, i_frame), key=lambda one: one[0])
    return best[1], best[2]


def frame_of(dataset: Dataset, pick: Pick) -> np.ndarray | None:
    """The image a point was picked in, or None if the dataset does not hold it, or it has no such pixel."""
    recording = find_recording(dataset, pick.recording)
    if recording is None or pick.camera not in recording.camera_names:
        return None
    camera = recording.camera(pick.camera)
    return camera.rgb(pick.frame) if 0 <= pick.frame < camera.n_frames else None


@dataclass(frozen=True)
class PointsInFrame:
    """Where k points are in one frame.

    Args:
        uv: (k, 2) pixels; NaN where that is not known, or behind the camera.
        states: of each: SEEN, BEHIND something, OUTSIDE the image, or UNKNOWN.
    """

    uv: np.ndarray
    states: list[str]


class TruePlaces:
    """Where points truly are in a recording: in their own scan by the cameras, elsewhere by the poses of objects."""

    def __init__(self, dataset: Dataset, picks: Sequence[Pick], name: str) -> None:
        self._picks, self._name = picks, name
        self._known = known_of(dataset, picks, name)
        self._truth = find_truth(dataset, name)

    @cached_property
    def places(self) -> np.ndarray:
        """(t, k, 3) metres, world; NaN where not known."""
        return true_places(self._picks, self._known, self._name)

    @cached_property
    def known(self) -> list[bool]:
        """Whether a point's place is known in any frame."""
        return np.isfinite(self.places).all(axis=2).any(axis=0).tolist()

    @cached_property
    def absent(self) -> list[bool]:
        """Whether the labels say that a point's object is not in this recording at all."""
        on = points_on_objects(self._picks, self._known)
        return [
            self._truth is not None
            and pick.recording != self._name
            and label > 0
            and label_of(self._truth, name, label) < 0
            for pick, label, name in zip(self._picks, on.labels, on.names, strict=True)
        ]

    def pixels(self, camera: Camera, i_frame: int) -> PointsInFrame:
        """Where the points are in a frame, and whether it shows them."""
        points = self.places[min(i_frame, len(self.places) - 1)]
        uv, inside, hidden = true_pixels(points, camera, self._truth, i_frame)
        columns = zip(np.isfinite(points).all(axis=1), inside, hidden, strict=True)
        states = [UNKNOWN if not k else OUTSIDE if not i else BEHIND if h else SEEN for k, i, h in columns]
        return PointsInFrame(uv, states)
