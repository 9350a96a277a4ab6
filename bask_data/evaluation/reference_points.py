"""Reference keypoints: where they were picked, and their ground truth in other views."""

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
"""Points chosen if there are no reference keypoints."""
N_LOOKED_AT = 24
"""Frames of each camera that are searched for the best one to pick in."""
INNER_BORDERS = (0.03, 0.015, 0.0)
"""Distances of such points from a mask's edge, as shares of the image's height; slim objects take the next."""
SEEN, BEHIND, OUTSIDE, UNKNOWN = "visible", "occluded", "out of view", "unknown"


def reference_points(dataset: Dataset, variants: Sequence[str]) -> list[Pick]:
    """The picks of the first of these variants that has reference keypoints, so that all networks look for the same.

    Without any, points well inside the objects of one training frame, for each set of objects that occur together.
    """
    for variant in variants:
        references = find(dataset, ReferenceKeypoints, "", variant)
        if references is not None and references.picks:
            return references.picks
    scene_of: dict[frozenset[str], tuple[Scan, VisibleMasks]] = {}
    for name in learned_scenes(dataset):
        scan, masks, truth = find(dataset, Scan, name), find(dataset, VisibleMasks, name), find_truth(dataset, name)
        if scan is not None and masks is not None and masks.n_instances:
            # Without labels it is unknown which scenes show the same objects.
            scene_of.setdefault(frozenset(truth.label_names.values() if truth else ()), (scan, masks))
    return [pick for scan, masks in scene_of.values() for pick in _inner_points(dataset, scan, masks)]


def _inner_points(dataset: Dataset, scan: Scan, masks: VisibleMasks) -> list[Pick]:
    """Points spread over each object, in the frame that shows most of all objects."""
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
    """The name of the pick's label, or else the instance's number."""
    truth = find_truth(dataset, pick.recording)
    label = picked_label(pick, truth)
    return truth.label_names.get(label, pick.name) if truth and label > 0 else pick.name


def _fullest_frame(scan: Scan, masks: VisibleMasks) -> tuple[Camera, int]:
    """The frame that shows most of all objects, by roots of areas so that large ones do not outweigh small ones."""
    best = (-1.0, scan.cameras[0], 0)
    for camera in scan.cameras:
        for i_frame in spread_frames(camera.n_frames, N_LOOKED_AT):
            sizes = np.bincount(masks.camera(camera.name).instance(i_frame).ravel(), minlength=2)[1:]
            best = max(best, (float(np.sqrt(sizes).sum()), camera, i_frame), key=lambda candidate: candidate[0])
    return best[1], best[2]


def frame_of(dataset: Dataset, pick: Pick) -> np.ndarray | None:
    """The image (h, w, 3) uint8 that a keypoint was picked in, or None if it is not in the dataset."""
    recording = find_recording(dataset, pick.recording)
    if recording is None or pick.camera not in recording.camera_names:
        return None
    camera = recording.camera(pick.camera)
    return camera.rgb(pick.frame) if 0 <= pick.frame < camera.n_frames else None


@dataclass(frozen=True)
class PointsInFrame:
    """Ground truth of k keypoints in one frame.

    Args:
        uv: (k, 2) pixels; NaN where unknown, or behind the camera.
        states: of each: SEEN, BEHIND an occluder, OUTSIDE the image, or UNKNOWN.
    """

    uv: np.ndarray
    states: list[str]


class TruePlaces:
    """Ground truth of keypoints in a recording: by the cameras in their own scan, elsewhere by the objects' poses."""

    def __init__(self, dataset: Dataset, picks: Sequence[Pick], name: str) -> None:
        self._picks, self._name = picks, name
        self._known = known_of(dataset, picks, name)
        self._truth = find_truth(dataset, name)

    @cached_property
    def places(self) -> np.ndarray:
        """Positions (t, k, 3), metres, world frame; NaN where unknown."""
        return true_places(self._picks, self._known, self._name)

    @cached_property
    def known(self) -> list[bool]:
        """Whether each keypoint's position is known in any frame."""
        return np.isfinite(self.places).all(axis=2).any(axis=0).tolist()

    @cached_property
    def absent(self) -> list[bool]:
        """Whether each keypoint's object is absent from this recording, by the labels."""
        on = points_on_objects(self._picks, self._known)
        return [
            self._truth is not None
            and pick.recording != self._name
            and label > 0
            and label_of(self._truth, name, label) < 0
            for pick, label, name in zip(self._picks, on.labels, on.names, strict=True)
        ]

    def pixels(self, camera: Camera, i_frame: int) -> PointsInFrame:
        """Pixels and visibility of the keypoints in a frame."""
        points = self.places[min(i_frame, len(self.places) - 1)]
        uv, inside, hidden = true_pixels(points, camera, self._truth, i_frame)
        columns = zip(np.isfinite(points).all(axis=1), inside, hidden, strict=True)
        states = [UNKNOWN if not k else OUTSIDE if not i else BEHIND if h else SEEN for k, i, h in columns]
        return PointsInFrame(uv, states)
