"""Figures of tracked keypoints, compared with ground truth where there is any."""

from __future__ import annotations

import math
from functools import cached_property
from typing import Any

import numpy as np

from bask_data.core.keypoint_scores import distances
from bask_data.core.landings import Landing, landing
from bask_data.core.scores import distribution
from bask_data.core.track_scores import object_shares, spread, step_length
from bask_data.dataset import Dataset
from bask_data.errors import BadData
from bask_data.evaluation.lookup import find, find_recording, find_truth, input_variant
from bask_data.evaluation.places import known_of, places_of
from bask_data.kinds import KeypointTrack, Pick, ReferenceKeypoints, Truth
from bask_data.kinds.places import object_poses, picked_label

TOLERANCE_PX = 5.0
"""Distance to its object within which a keypoint counts as near, pixels: the accuracy of hand-drawn labels."""


class TrackScores:
    """A track compared with the ground truth of its demonstration, where there is any."""

    def __init__(self, dataset: Dataset, demonstration: str, variant: str) -> None:
        track = find(dataset, KeypointTrack, demonstration, variant)
        assert track is not None, "only tracks that exist are scored"
        self.track = track
        self.recording = find_recording(dataset, demonstration)
        self.truth = find_truth(dataset, demonstration)
        self._dataset, self._variant = dataset, variant

    @cached_property
    def reference(self) -> ReferenceKeypoints | None:
        """The reference keypoints that are tracked."""
        return input_variant(self._dataset, self.track, ReferenceKeypoints, self._variant)

    @cached_property
    def picks(self) -> list[Pick | None]:
        """The pick of each keypoint, by name; None if the reference lacks it."""
        by_name = {pick.name: pick for pick in self.reference.picks} if self.reference else {}
        return [by_name.get(name) for name in self.track.names]

    @cached_property
    def picked_labels(self) -> list[int]:
        """Ground-truth label that each keypoint was picked on: 0 is background, -1 unknown."""
        picked = [pick for pick in self.picks if pick]
        known = known_of(self._dataset, picked)
        here = [pick for pick in picked if pick.recording in known]
        labels = {pick.name: picked_label(pick, known[pick.recording].truth) for pick in here}
        return [labels.get(name, -1) for name in self.track.names]

    @cached_property
    def labels(self) -> np.ndarray:
        """Object label of each keypoint; 0 where unknown or background."""
        return np.array([max(label, 0) for label in self.picked_labels], dtype=np.int64)

    @cached_property
    def places(self) -> np.ndarray:
        """Ground-truth positions (t, k, 3), metres, world frame; NaN where unknown."""
        n, k = len(self.track.mean), len(self.track.names)
        places, indices = np.full((n, k, 3), np.nan), [i for i, pick in enumerate(self.picks) if pick]
        if self.recording is not None and indices:
            known = places_of(self._dataset, [pick for pick in self.picks if pick], self.recording.path.name)[:n]
            places[: len(known), indices] = known
        return places

    @cached_property
    def with_place(self) -> np.ndarray:
        """(k,) bool: keypoints with ground truth in some frame."""
        return np.isfinite(self.places).all(axis=2).any(axis=0)

    @cached_property
    def error(self) -> np.ndarray:
        """Errors (t, k), metres; NaN where unknown."""
        return distances(self.track.mean, self.places)

    @cached_property
    def spread(self) -> np.ndarray:
        """Spread (t, k), metres."""
        return spread(self.track.covariance)

    @cached_property
    def landings(self) -> dict[str, list[Landing]]:
        """Per camera with labels, where the keypoints lie in each frame."""
        truth = self.truth
        if truth is None or not self.labels.any():
            return {}
        sizes = (
            {camera.name: (camera.height, camera.width) for camera in self.recording.cameras} if self.recording else {}
        )
        return {
            camera: [
                landing(pixel, self.labels, _checked(truth, camera, i_frame, sizes.get(camera)), TOLERANCE_PX)
                for i_frame, pixel in enumerate(self.track.pixel(camera))
            ]
            for camera in self.track.camera_names
            if camera in truth.camera_names
        }

    @property
    def all_landings(self) -> list[Landing]:
        """Landings of all cameras and frames."""
        return [landing for landings in self.landings.values() for landing in landings]

    def why_no_error(self) -> str:
        """Why there is no error, in words; empty if there is one."""
        if self.with_place.any():
            return ""
        if self.truth is None:
            return "there is no ground truth for this demonstration"
        if self.reference is None:
            return "the reference keypoints of the track are missing"
        if not self.labels.any():
            return "the reference keypoints were picked on no labelled object"
        if not object_poses(self.truth):
            return "the ground truth of this demonstration has no poses of its objects"
        return "no object with a keypoint has a known pose in both recordings"

    def why_no_share(self) -> str:
        """Why there is no share on the correct object, in words; empty if there is one."""
        if self.truth is None:
            return "there is no ground truth for this demonstration"
        if not self.labels.any():
            return "no label is known for any reference keypoint's object"
        if not self.landings:
            return "the ground truth has no labels for the track's cameras"
        if not any(landing.in_view.any() for landing in self.all_landings):
            return "no keypoint's object is in view by the labels"
        return ""


def _checked(truth: Truth, camera: str, i_frame: int, size: tuple[int, int] | None) -> np.ndarray:
    """The labels (h, w) of a frame, which must be as large as its image."""
    labels = truth.instance(camera, i_frame)
    if size is not None and labels.shape != size:
        raise BadData(truth.path / camera / "instance", "shape", expected=f"{size} as the images", got=labels.shape)
    return labels


def figures_of_track(scored: TrackScores) -> dict[str, Any]:
    """The figures of one track."""
    track, truth = scored.track, scored.truth
    error, landings = scored.error, scored.all_landings
    with_place = scored.with_place
    pose_error = truth.metadata.pose_error if truth else {}
    return {
        "filter": track.metadata.filter,
        "n_frames": len(track.mean),
        "n_keypoints": len(track.names),
        "localised_share": float(np.isfinite(track.mean).all(axis=2).mean()) if track.mean.size else math.nan,
        "error_m": distribution(error),
        "error_last_frame_m": distribution(error[-1:]),
        "n_keypoints_with_place": int(with_place.sum()),
        "within_2cm": _share_below(error, 0.02),
        "within_5cm": _share_below(error, 0.05),
        "why_no_error": scored.why_no_error(),
        "truth_error_m": {
            truth.label_names.get(label, str(label)): value
            for label, value in pose_error.items()
            if truth is not None and label in set(scored.labels[with_place].tolist())
        },
        "on_object": object_shares(landings),
        "tolerance_px": TOLERANCE_PX,
        "why_no_share": scored.why_no_share(),
        "spread_m": distribution(scored.spread),
        "step_m": distribution(step_length(track.mean)),
        "keypoints": [_keypoint_row(scored, i) for i in range(len(track.names))],
    }


def _share_below(error: np.ndarray, limit: float) -> float:
    known = np.isfinite(error)
    return float((error[known] < limit).mean()) if known.any() else math.nan


def _keypoint_row(scored: TrackScores, i: int) -> dict[str, Any]:
    truth, label = scored.truth, scored.picked_labels[i]
    pick = scored.picks[i]
    names: dict[int, str] = {}
    if pick is not None:
        picked_in = find_truth(scored._dataset, pick.recording)
        names = picked_in.label_names if picked_in else {}
    names = {**(truth.label_names if truth else {}), **names}
    chosen = np.arange(len(scored.picks)) == i
    return {
        "name": scored.track.names[i],
        "object": "unknown" if label < 0 else "background" if label == 0 else names.get(label, f"label {label}"),
        "object_here": truth is not None and label > 0 and label in truth.label_names,
        "error_m": distribution(scored.error[:, i]),
        "on_object": object_shares(scored.all_landings, chosen),
        "spread_m": distribution(scored.spread[:, i]),
        "localised_share": float(np.isfinite(scored.track.mean[:, i]).all(axis=1).mean()),
    }
