"""All figures of a dataset, measured once for page and summary."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, is_dataclass
from typing import Any

import numpy as np

from bask_data.artifact import read_json
from bask_data.dataset import Dataset
from bask_data.evaluation.artifact_figures import (
    masks_figures,
    matches_figures,
    objects_figures,
    reconstruction_figures,
    recording_figures,
)
from bask_data.evaluation.keypoint_study import FILE
from bask_data.evaluation.lookup import UNREADABLE, find, find_recording, find_truth, what_is_wrong
from bask_data.evaluation.made import made
from bask_data.evaluation.network_figures import descriptor_figures, descriptors_figures
from bask_data.evaluation.track_figures import TrackScores, figures_of_track
from bask_data.kinds import Correspondences, DescriptorNet, KeypointTrack, ObjectInstances, Reconstruction, VisibleMasks


def plain(value: Any) -> Any:
    """The value for JSON: dataclasses as objects, numbers that are not finite as None."""
    if is_dataclass(value) and not isinstance(value, type):
        return plain(asdict(value))
    if isinstance(value, dict):
        return {str(key): plain(part) for key, part in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(part) for part in value]
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, np.generic):
        return plain(value.item())
    return None if isinstance(value, float) and not math.isfinite(value) else value


class Measured:
    """Figures that need many frames, measured once for page and summary."""

    def __init__(self, dataset: Dataset) -> None:
        self._dataset = dataset
        self._masks: dict[str, dict[str, Any]] = {}
        self._tracks: dict[tuple[str, str], TrackScores] = {}
        self._descriptors: dict[str, Any] | None = None

    def masks(self, scene: str) -> dict[str, Any]:
        """Figures of a scene's masks, or `error` if they cannot be read."""
        if scene not in self._masks:
            try:
                figures = masks_figures(find(self._dataset, VisibleMasks, scene), find_truth(self._dataset, scene))
            except UNREADABLE as error:
                figures = {"error": what_is_wrong(error)}
            self._masks[scene] = figures
        return self._masks[scene]

    def descriptors(self) -> dict[str, Any]:
        """Figures of `evaluate descriptor` for the first few networks on few pairs, and `errors` by what cannot be read
        or measured; empty without any network."""
        if self._descriptors is None:
            self._descriptors = descriptors_figures(self._dataset)
        return self._descriptors

    def track(self, demonstration: str, variant: str) -> TrackScores:
        """Scores of a track that exists."""
        if (demonstration, variant) not in self._tracks:
            self._tracks[demonstration, variant] = TrackScores(self._dataset, demonstration, variant)
        return self._tracks[demonstration, variant]


def summary(dataset: Dataset, measured: Measured) -> dict[str, Any]:
    """All figures of all items."""
    scenes, demonstrations = dataset.items("scene"), dataset.items("demonstration")
    result: dict[str, Any] = {
        "dataset": dataset.file.name,
        "artifacts": made(dataset),
        "recordings": _each(dataset.items("recording"), lambda name: recording_figures(find_recording(dataset, name))),
        "reconstruction": _each(scenes, lambda name: reconstruction_figures(find(dataset, Reconstruction, name))),
        "objects": _each(scenes, lambda name: objects_figures(find(dataset, ObjectInstances, name))),
        "masks": _each(scenes, measured.masks),
        "correspondences": _each(scenes, lambda name: matches_figures(find(dataset, Correspondences, name))),
        "descriptor": _each(
            list(dataset.variants(DescriptorNet)),
            lambda variant: descriptor_figures(find(dataset, DescriptorNet, "", variant)),
        ),
        "evaluation": measured.descriptors(),
        "keypoints": _each(
            list(dataset.variants(KeypointTrack)),
            lambda variant: _each(demonstrations, lambda name: track_figures(dataset, measured, name, variant)),
        ),
        "study": _each(_studied(dataset), lambda name: _study_figures(dataset, name)),
    }
    return plain({name: value for name, value in result.items() if value not in ({}, None)})


def _studied(dataset: Dataset) -> list[str]:
    """The sets of objects of the dataset's last study of keypoints; none if unreadable, which the page reports."""
    try:
        return list(read_json(dataset.root / FILE)["groups"]) if (dataset.root / FILE).exists() else []
    except (*UNREADABLE, TypeError):
        return []


def _study_figures(dataset: Dataset, name: str) -> dict[str, Any]:
    """By method: errors, and distances between mean and mode, by visibility; and the certainty."""
    methods = read_json(dataset.root / FILE)["groups"][name]["methods"]
    kept = ("error", "apart", "certainty")
    return {method: {what: figures[what] for what in kept if what in figures} for method, figures in methods.items()}


def _each(names: Sequence[str], figures: Any) -> dict[str, Any]:
    """Figures by name, without empty ones; `error` for what cannot be read."""
    result: dict[str, Any] = {}
    for name in names:
        try:
            value = figures(name)
        except UNREADABLE as error:
            value = {"error": what_is_wrong(error)}
        if value:
            result[name] = value
    return result


def track_figures(dataset: Dataset, measured: Measured, demonstration: str, variant: str) -> dict[str, Any]:
    """Spread, motion and, with ground truth, errors of the keypoints of a demonstration."""
    if find(dataset, KeypointTrack, demonstration, variant) is None:
        return {}
    return figures_of_track(measured.track(demonstration, variant))
