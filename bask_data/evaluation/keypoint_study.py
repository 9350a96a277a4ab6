"""Accuracy of keypoints that networks and filters track through demonstrations with ground truth.

The study of von Hartz et al. 2023, Sec. IV-A: distance of each keypoint to ground truth, and between mean and mode of
its belief, over time and by visibility, for several networks, with the expectation of single frames and with filters.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from bask_data.artifact import write_text_atomically
from bask_data.dataset import Dataset
from bask_data.evaluation.held_out import check_variants
from bask_data.evaluation.places import known_of
from bask_data.evaluation.study_comparisons import comparisons
from bask_data.evaluation.study_figures import group_figures
from bask_data.evaluation.study_tracks import Tracked, TrackingRun, methods_of, references_of, tracked_in
from bask_data.evaluation.tracked_points import by_objects, demonstrations_with_truth, points_to_track
from bask_data.kinds import Demonstration, DescriptorNet, Truth
from bask_data.kinds.places import points_on_objects

if TYPE_CHECKING:
    from bask_data.core.filters.table import FilterSettings, SettingsName
    from bask_data.nn.network import DescriptorNetwork

FILE = Path("evaluation") / "keypoints.json"
"""The file of a dataset's last study, for its report."""


@dataclass(frozen=True)
class StudySettings:
    """What a study of keypoints tracks, and where.

    Args:
        demonstrations: by default all with ground-truth poses of the objects.
        objects: to put keypoints on; by default all of each demonstration.
        cameras: to track with; by default all of each demonstration.
        reference: variant of the reference keypoints to track; by default points spread over the objects in a training
            scan.
        pick_in: recordings to pick these points in, rather than training scans.
        n_keypoints: number of these points, shared among the objects; the paper tracks 16.
        filters: preset of the filters' settings.
        seed: for the points and the particle filter.
        stride: every so many-th frame is tracked, by all methods alike, as by a slower camera.
    """

    demonstrations: Sequence[str] = ()
    objects: Sequence[str] = ()
    cameras: Sequence[str] = ()
    reference: str = ""
    pick_in: Sequence[str] = ()
    n_keypoints: int = 16
    filters: SettingsName = "default"
    seed: int = 0
    stride: int = 1


def evaluated_keypoints(
    dataset: Dataset, variants: Sequence[str] = ("main",), settings: StudySettings | None = None
) -> dict[str, Any]:
    """The study's figures as plain JSON values, by set of objects and method.

    Args:
        variants: descriptor networks; the first is studied with all filters, the others with expectation alone.

    Raises:
        UsageError: something asked for does not exist, or there is no ground truth to compare tracks with.
        BadData: an artifact does not load, or its parts are inconsistent.
    """
    settings = settings or StudySettings()
    check_variants(dataset, variants)
    networks = {name: DescriptorNet(dataset.path(DescriptorNet, variant=name)).network() for name in variants}
    units = {name: _unit(dataset, name, network) for name, network in networks.items()}
    methods = methods_of(units, settings.filters)
    run = TrackingRun(settings.cameras, settings.seed, settings.stride)
    groups = by_objects(dataset, demonstrations_with_truth(dataset, settings.demonstrations), settings.objects)
    figures: dict[str, Any] = {}
    all_tracks: list[Tracked] = []
    for tracked_objects, names in groups.items():
        picks = points_to_track(
            dataset,
            tracked_objects,
            settings.n_keypoints,
            settings.reference,
            settings.seed,
            settings.pick_in,
            settings.cameras,
        )
        with TemporaryDirectory(prefix="bask-data-") as folder:
            references = {
                name: references_of(dataset, network, picks, Path(folder) / name) for name, network in networks.items()
            }
            tracks = [tracked_in(dataset, name, picks, networks, references, methods, run) for name in names]
        on = points_on_objects(picks, known_of(dataset, picks)).names
        figures["+".join(tracked_objects)] = {
            **group_figures(picks, on, tracks, methods),
            "comparisons": comparisons(tracks, methods, settings.seed),
        }
        all_tracks += tracks
    return {
        "settings": settings.filters,
        "seed": settings.seed,
        "stride": settings.stride,
        "methods": [
            {
                "name": method.name,
                "variant": method.variant,
                "belief": method.belief,
                "settings": plain_settings(method.settings),
            }
            for method in methods
        ],
        "margins": {
            name: margin_distances(_trained_with(dataset, name), network.settings.descriptor_dim)
            for name, network in networks.items()
        },
        "measured_with": _digests(dataset, variants, [name for names in groups.values() for name in names]),
        "groups": figures,
        "comparisons": comparisons(all_tracks, methods, settings.seed),
    }


def plain_settings(settings: FilterSettings) -> dict[str, Any]:
    """Settings for JSON; None stands for an infinite limit."""
    return {name: None if value in (math.inf, -math.inf) else value for name, value in asdict(settings).items()}


def save_study(dataset: Dataset, result: Mapping[str, Any]) -> Path:
    """Save a study where the dataset's report finds it, replacing an earlier one in one step."""
    path = dataset.root / FILE
    write_text_atomically(path, json.dumps(result, allow_nan=False) + "\n")
    return path


def is_current(dataset: Dataset, result: Mapping[str, Any]) -> bool:
    """Whether the dataset still holds the artifacts that a study was made with."""
    measured_with: Mapping[str, str] = result["measured_with"]
    return all(_digest(dataset.root / path) == digest for path, digest in measured_with.items())


def _unit(dataset: Dataset, variant: str, network: DescriptorNetwork) -> float:
    """Unit of a network's training distances: 1, or 1 / sqrt(D) if they were not divided by sqrt(D)."""
    params = _trained_with(dataset, variant)
    return 1.0 if params.get("normalised", True) else float(network.settings.descriptor_dim) ** -0.5


def _trained_with(dataset: Dataset, variant: str) -> Mapping[str, Any]:
    return DescriptorNet(dataset.path(DescriptorNet, variant=variant)).manifest.params


def margin_distances(params: Mapping[str, Any], dimension: int) -> dict[str, float] | None:
    """Descriptor distances of the filters from which on the contrastive loss leaves non-matches alone, by where these
    are; None for other losses.

    Args:
        params: of the training.
        dimension: of the descriptors.
    """
    if params.get("loss") != "contrastive":
        return None
    found = {}
    for where in ("foreground", "background"):
        margin = float(params[f"margin_{where}"])
        # The hinge of the squared distance ends at the margin's root.
        distance = math.sqrt(margin) if params.get("hinge", "squared") == "squared" else margin
        is_divided = where == "foreground" or params.get("background_normalised", True)
        is_divided = is_divided and params.get("normalised", True)
        found[where] = distance if is_divided else distance / math.sqrt(dimension)
    return found


def _digests(dataset: Dataset, variants: Sequence[str], demonstrations: Sequence[str]) -> dict[str, str]:
    paths = [
        *(dataset.path(DescriptorNet, variant=name) for name in variants),
        *(dataset.path(kind, name) for name in demonstrations for kind in (Demonstration, Truth)),
    ]
    return {path.relative_to(dataset.root).as_posix(): _digest(path) for path in paths}


def _digest(path: Path) -> str:
    from bask_data.artifact import MANIFEST, Artifact

    return Artifact(path).manifest.digest if (path / MANIFEST).exists() else ""
