"""Demonstrations tracked by all methods that a study of keypoints compares, in one pass over the frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from bask_data.dataset import Dataset
from bask_data.evaluation.tracked_points import true_tracks, whole
from bask_data.kinds import Camera, Demonstration, Pick, ReferenceKeypoints, Truth
from bask_data.kinds.places import true_pixels
from bask_data.observing import moment_of
from bask_data.progress import progress
from bask_data.stages.encode import cameras_of, grippers_of
from bask_data.stages.keypoint_evidence import measured
from bask_data.tracker import KeypointTracker, TrackedKeypoints

if TYPE_CHECKING:
    import numpy as np

    from bask_data.core.filters.table import FilterSettings, SettingsName
    from bask_data.core.keypoint_scores import Sighting
    from bask_data.nn.network import DescriptorNetwork

HISTOGRAM_EVERY = 5
"""One frame in this many is counted in the histograms of distances, because neighbouring frames are alike."""
NEAR_SHARE = 0.02
"""Radius of a keypoint's surroundings, as a share of the image's diagonal."""
MAP_SIZE = 64
"""Width of an example's distance map, pixels."""


@dataclass(frozen=True)
class Method:
    """A method of tracking: a network and a kind of belief."""

    variant: str
    belief: str
    settings: FilterSettings

    @property
    def name(self) -> str:
        return f"{self.variant}: {self.belief}"


def methods_of(units: Mapping[str, float], settings: SettingsName) -> list[Method]:
    """The methods that are compared: all beliefs with the first network, expectation with the others.

    Args:
        units: by variant, the unit of its network's training distances in units of the filters' distances. The
            temperature is meant for distances as trained; otherwise, a network with small distances would seem to
            distinguish nothing.
        settings: preset of all filters.
    """
    from bask_data.core.filters.table import FILTERS, alpha_of_one_frame, filter_named, settings_named

    first, *others = units
    methods = []
    for name in FILTERS:
        if not filter_named(name).by_single_frames:
            methods.append(Method(first, name, settings_named(name, settings)))
            continue
        alpha = alpha_of_one_frame(name, settings) or 1.0
        temperatures = {variant: settings_named(name, settings, alpha=alpha / units[variant]) for variant in units}
        none = settings_named(name, settings, alpha=1.0 / units[first])
        methods += [
            *(Method(variant, name, temperatures[variant]) for variant in reversed(others)),
            Method(first, f"{name}, no temperature", none),
            Method(first, name, temperatures[first]),
        ]
    return methods


@dataclass(frozen=True)
class TrackingRun:
    """How a demonstration is run through: with which cameras (all if empty) and random numbers, and in which frames.

    Attributes:
        stride: every so many-th frame is tracked, by all methods alike.
    """

    cameras: Sequence[str] = ()
    seed: int = 0
    stride: int = 1


@dataclass
class Tracked:
    """A demonstration tracked by all methods, in t of its frames.

    Attributes:
        frames: (t,) their numbers.
        places: (t, k, 3) ground-truth positions, metres, world frame; NaN where unknown.
        uv: (c, t, k, 2) pixels of these; NaN behind the camera.
        shown: (c, t, k) whether each camera shows them.
        mean, mode: by method (t, k, 3), metres, world frame.
        covariance: by method (t, k, 3, 3), square metres.
        observed: by method (t, c, k), whether the camera sees the keypoint by the belief.
        pixel: by method (t, c, k, 2) of the mean.
        counts: by variant and group of pixels, their histogram of descriptor distances.
        first_maps: by variant, the first camera's distance maps of the first frame (k, h, w), coarse.
    """

    name: str
    cameras: list[str]
    frames: list[int]
    places: np.ndarray
    seen: Sighting
    uv: np.ndarray
    shown: np.ndarray
    mean: dict[str, np.ndarray] = field(default_factory=dict)
    mode: dict[str, np.ndarray] = field(default_factory=dict)
    covariance: dict[str, np.ndarray] = field(default_factory=dict)
    observed: dict[str, np.ndarray] = field(default_factory=dict)
    pixel: dict[str, np.ndarray] = field(default_factory=dict)
    counts: dict[str, dict[str, np.ndarray]] = field(default_factory=dict)
    first_maps: dict[str, np.ndarray] = field(default_factory=dict)


def references_of(
    dataset: Dataset, network: DescriptorNetwork, picks: Sequence[Pick], folder: Path
) -> ReferenceKeypoints:
    """Reference keypoints with a network's descriptors of the picks, and what these tell the filters, measured as
    `reference` does."""
    import numpy as np

    descriptors, recordings = [], {}
    for pick in picks:
        picked_in = whole(dataset, pick.recording)
        assert picked_in is not None, "points are picked where there is ground truth"
        recordings[pick.recording] = picked_in.recording
        image = picked_in.recording.camera(pick.camera).rgb(pick.frame)
        uv = np.array([[pick.u, pick.v]], dtype=np.float32)
        descriptors.append(network.descriptors_at(image, uv)[0].cpu().numpy())
    calibration = measured(picks, np.stack(descriptors), recordings, network)
    ReferenceKeypoints.write(folder, descriptors=np.stack(descriptors), picks=list(picks), calibration=calibration)
    return ReferenceKeypoints(folder)


def settings_in(method: Method, reference: ReferenceKeypoints) -> FilterSettings:
    """A method's settings: the defaults of a filter with alpha and tau as measured for the references, if they were."""
    from bask_data.core.filters.calibrated import calibrated_settings
    from bask_data.core.filters.table import filter_of, settings_named

    by_single_frames = filter_of(method.settings).by_single_frames
    if by_single_frames or method.settings != settings_named(method.belief):
        return method.settings
    return calibrated_settings(method.belief, reference.calibration)


def tracked_in(
    dataset: Dataset,
    name: str,
    picks: Sequence[Pick],
    networks: Mapping[str, DescriptorNetwork],
    references: Mapping[str, ReferenceKeypoints],
    methods: Sequence[Method],
    run: TrackingRun,
) -> Tracked:
    """One pass over a demonstration's frames, each described once by each network and tracked as `encode` does."""
    import numpy as np

    source = whole(dataset, name)
    assert source is not None, "only demonstrations with ground truth are tracked"
    demonstration = source.recording
    assert isinstance(demonstration, Demonstration), "scans are not tracked"
    cameras = cameras_of(demonstration, tuple(run.cameras))
    tracked = _with_truth(dataset, name, cameras, picks, run.stride)
    trackers = {
        method.name: KeypointTracker(
            networks[method.variant],
            references[method.variant],
            settings_in(method, references[method.variant]),
            run.seed,
            cameras=tracked.cameras,
        )
        for method in methods
    }
    grippers, keypoints_by = (
        grippers_of(demonstration, cameras[0].n_frames),
        {name: list[TrackedKeypoints]() for name in trackers},
    )
    for t, i_frame in enumerate(progress(tracked.frames, f"tracking in {name}")):
        moment = moment_of(cameras, i_frame)
        for variant in networks:
            mine = [method.name for method in methods if method.variant == variant]
            look = trackers[mine[0]].look(*moment)
            _count(tracked, variant, source.truth, look.observations[cameras[0].name].distance, t)
            for method in mine:
                keypoints_by[method].append(
                    trackers[method].update(look, None if grippers is None else grippers[i_frame])
                )
    for method, keypoints in keypoints_by.items():
        tracked.mean[method] = np.stack([of_frame.mean for of_frame in keypoints])
        tracked.mode[method] = np.stack([of_frame.mode for of_frame in keypoints])
        tracked.covariance[method] = np.stack([of_frame.covariance for of_frame in keypoints])
        tracked.observed[method] = np.stack([np.stack([*of_frame.observed.values()]) for of_frame in keypoints])
        tracked.pixel[method] = np.stack([np.stack([*of_frame.pixel.values()]) for of_frame in keypoints])
    return tracked


def _with_truth(dataset: Dataset, name: str, cameras: Sequence[Camera], picks: Sequence[Pick], stride: int) -> Tracked:
    """A demonstration before tracking, with ground truth and visibility of the points."""
    import numpy as np

    from bask_data.core.keypoint_scores import sighting

    source = whole(dataset, name)
    assert source is not None, "only demonstrations with ground truth are tracked"
    all_places = true_tracks(dataset, picks, name)
    frames = [*range(0, len(all_places), stride)]
    places = all_places[frames]
    pixels = [
        [true_pixels(point, camera, source.truth, i) for i, point in zip(frames, places, strict=True)]
        for camera in cameras
    ]
    inside, hidden = (
        np.array([[getattr(frame, what) for frame in frames] for frames in pixels]) for what in ("inside", "hidden")
    )
    uv = np.array([[frame.uv for frame in frames] for frames in pixels])
    seen = sighting(inside, hidden, places)
    return Tracked(name, [camera.name for camera in cameras], frames, places, seen, uv, inside & ~hidden)


def _coarse(maps: np.ndarray) -> np.ndarray:
    """Maps (k, h, w) shrunk to a width of `MAP_SIZE`, or as they are."""
    import cv2
    import numpy as np

    height, width = maps.shape[1:]
    if width <= MAP_SIZE:
        return maps
    size = (MAP_SIZE, max(round(height * MAP_SIZE / width), 1))
    return np.stack([cv2.resize(map_, size, interpolation=cv2.INTER_AREA) for map_ in maps])


def _count(tracked: Tracked, variant: str, truth: Truth, distance: np.ndarray, t: int) -> None:
    """Add the first camera's distance maps (k, h, w) of visible keypoints to the histograms of pixels near the
    keypoint, elsewhere on objects, and on background; keep the first frame's maps."""
    import numpy as np

    from bask_data.core.geometry import pixel_grid, scale_pixels
    from bask_data.core.keypoint_scores import z_counts, z_edges
    from bask_data.kinds.truth import ROBOT

    if t == 0:
        tracked.first_maps[variant] = _coarse(distance)
    if t % HISTOGRAM_EVERY:
        return
    labels = truth.instance(tracked.cameras[0], tracked.frames[t])
    uv = scale_pixels(tracked.uv[0, t], labels.shape, distance.shape[1:])
    shown = np.flatnonzero(tracked.seen.visible[t] & np.isfinite(uv).all(axis=1))
    height, width = distance.shape[1:]
    away = np.linalg.norm(pixel_grid(height, width)[None] - uv[shown, None, None], axis=3)
    near = away <= NEAR_SHARE * np.hypot(height, width)
    v, u = (np.arange(n) * size // n for n, size in zip((height, width), labels.shape, strict=True))
    on_object = np.isin(labels[np.ix_(v, u)], (0, ROBOT), invert=True)[None] & ~near
    groups = {"near": near, "objects": on_object, "background": ~near & ~on_object}
    counts = tracked.counts.setdefault(variant, {})
    for group, n_pixels in z_counts(distance[shown], groups, z_edges()).items():
        counts[group] = counts.get(group, 0) + n_pixels
