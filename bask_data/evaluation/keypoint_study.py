"""How right keypoints are that networks and filters track through demonstrations whose truth is known.

The study of von Hartz et al. 2023, Sec. IV-A: distance of each keypoint to where it truly is, and between mean and
mode of what is believed of it, over time, by what the cameras see, for networks beside each other and with the belief
of single frames and of each filter over time.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from bask_data.artifact import write_text_atomically
from bask_data.dataset import Dataset
from bask_data.evaluation.held_out import check_variants
from bask_data.evaluation.places import known_of
from bask_data.evaluation.tracked_points import (
    by_objects,
    demonstrations_with_truth,
    points_to_track,
    true_tracks,
    whole,
)
from bask_data.kinds import Camera, Demonstration, DescriptorNet, Pick, ReferenceKeypoints, Truth
from bask_data.kinds.places import points_on_objects, true_pixels
from bask_data.progress import progress
from bask_data.stages.encode import cameras_of, grippers_of
from bask_data.tracker import KeypointTracker, TrackedKeypoints, moment_of

if TYPE_CHECKING:
    import numpy as np

    from bask_data.core.filters.table import FilterSettings, SettingsName
    from bask_data.core.keypoint_scores import Sighting
    from bask_data.nn.network import DescriptorNetwork

N_MOMENTS = 101
"""Moments of the normalised time axis."""
HISTOGRAM_EVERY = 5
"""One of so many frames is counted in the histograms of distances: neighbours tell the same."""
NEAR = 0.02
"""Share of the image's diagonal within which a pixel shows a keypoint's surroundings."""
N_EXAMPLE_FRAMES = 6
MAP_SIZE = 64
"""Pixels of an example's distance map."""
FILE = Path("evaluation") / "keypoints.json"
"""Where a dataset keeps the last study, for its report."""


@dataclass(frozen=True)
class Method:
    """A way to track: whose network, and which belief."""

    variant: str
    belief: str
    settings: FilterSettings

    @property
    def name(self) -> str:
        return f"{self.variant}: {self.belief}"


def methods_of(units: Mapping[str, float], settings: SettingsName) -> list[Method]:
    """What is compared: all beliefs with the first network, that of single frames with the others.

    Args:
        units: by variant, what its network's distances were divided by when it was trained, in units of what filters
            divide them by. The temperature is made for distances as they were trained: else a network whose distances
            are small would be said to know nothing.
        settings: preset of all filters.
    """
    from bask_data.core.filters.table import FILTERS, alpha_of_one_frame, filter_named, settings_named

    first, *others = units
    found = []
    for name in FILTERS:
        if not filter_named(name).by_single_frames:
            found.append(Method(first, name, settings_named(name, settings)))
            continue
        alpha = alpha_of_one_frame(name, settings) or 1.0
        temperatures = {variant: settings_named(name, settings, alpha=alpha / units[variant]) for variant in units}
        none = settings_named(name, settings, alpha=1.0 / units[first])
        found += [
            *(Method(variant, name, temperatures[variant]) for variant in reversed(others)),
            Method(first, f"{name}, no temperature", none),
            Method(first, name, temperatures[first]),
        ]
    return found


@dataclass
class Tracked:
    """A demonstration tracked in all ways.

    Attributes:
        places: (t, k, 3), metres, world: where the points truly are; NaN where that is not known.
        uv: (c, t, k, 2) pixels of these; NaN behind the camera.
        mean, mode: by method (t, k, 3), metres, world.
        pixel: by method (t, c, k, 2) of the mean.
        counts: by variant and group of pixels, their histogram of descriptor distances.
        first_maps: by variant, the first camera's distance maps of the first frame (k, h, w), coarse.
    """

    name: str
    cameras: list[str]
    places: np.ndarray
    seen: Sighting
    uv: np.ndarray
    mean: dict[str, np.ndarray] = field(default_factory=dict)
    mode: dict[str, np.ndarray] = field(default_factory=dict)
    pixel: dict[str, np.ndarray] = field(default_factory=dict)
    counts: dict[str, dict[str, np.ndarray]] = field(default_factory=dict)
    first_maps: dict[str, np.ndarray] = field(default_factory=dict)


def evaluated_keypoints(
    dataset: Dataset,
    variants: Sequence[str] = ("main",),
    *,
    demonstrations: Sequence[str] = (),
    objects: Sequence[str] = (),
    cameras: Sequence[str] = (),
    reference: str = "",
    pick_in: Sequence[str] = (),
    n_keypoints: int = 16,
    settings: SettingsName = "default",
    seed: int = 0,
) -> dict[str, Any]:
    """The study's figures as plain JSON values: of each set of objects, of each method.

    Args:
        variants: descriptor networks. All beliefs are studied with the first, that of single frames with the others.
        demonstrations: by default all whose truth knows where the objects are.
        objects: to put keypoints on; by default all of each demonstration.
        cameras: to track with; by default all of each demonstration.
        reference: variant of the reference keypoints to track; by default points spread over the objects in a scan that
            networks learn from.
        pick_in: recordings to put these points in, rather than scans.
        settings: preset of the filters.
        seed: of the points, and of the particle filter.

    Raises:
        UsageError: something asked for is not there, or there is no truth to hold tracks against.
        BadData: an artifact does not load, or its parts do not belong together.
    """
    check_variants(dataset, variants)
    networks = {name: DescriptorNet(dataset.path(DescriptorNet, variant=name)).network() for name in variants}
    units = {name: _unit(dataset, name, network) for name, network in networks.items()}
    methods = methods_of(units, settings)
    groups = by_objects(dataset, demonstrations_with_truth(dataset, demonstrations), objects)
    found: dict[str, Any] = {}
    for tracked_objects, names in groups.items():
        picks = points_to_track(dataset, tracked_objects, n_keypoints, reference, seed, pick_in, cameras)
        with TemporaryDirectory(prefix="bask-data-") as folder:
            references = {
                name: _references(dataset, network, picks, Path(folder) / name) for name, network in networks.items()
            }
            tracks = [_tracked(dataset, name, cameras, picks, networks, references, methods, seed) for name in names]
        on = points_on_objects(picks, known_of(dataset, picks)).names
        found["+".join(tracked_objects)] = _told(picks, on, tracks, methods)
    return {
        "settings": settings,
        "seed": seed,
        "methods": [
            {"name": one.name, "variant": one.variant, "belief": one.belief, "settings": _told_settings(one.settings)}
            for one in methods
        ],
        "margins": {name: _margins(dataset, name, unit) for name, unit in units.items()},
        "measured_with": _digests(dataset, variants, [name for names in groups.values() for name in names]),
        "groups": found,
    }


def _told_settings(settings: FilterSettings) -> dict[str, Any]:
    """Settings as JSON has them, which knows no infinity: null stands for no limit."""
    return {name: None if value in (math.inf, -math.inf) else value for name, value in asdict(settings).items()}


def save_study(dataset: Dataset, found: Mapping[str, Any]) -> Path:
    """Keep a study where the dataset's report finds it; what was there is replaced in one step."""
    path = dataset.root / FILE
    write_text_atomically(path, json.dumps(found, allow_nan=False) + "\n")
    return path


def is_current(dataset: Dataset, found: Mapping[str, Any]) -> bool:
    """Whether what a study was made with is still what the dataset holds."""
    measured_with: Mapping[str, str] = found["measured_with"]
    return all(_digest(dataset.root / path) == digest for path, digest in measured_with.items())


def _unit(dataset: Dataset, variant: str, network: DescriptorNetwork) -> float:
    """One, but for networks that were trained on distances not divided by sqrt(D)."""
    params = DescriptorNet(dataset.path(DescriptorNet, variant=variant)).manifest.params
    return 1.0 if params.get("normalised", True) else float(network.settings.descriptor_dim) ** -0.5


def _margins(dataset: Dataset, variant: str, unit: float) -> dict[str, float] | None:
    """Descriptor distances that training pushed non-matches beyond, as filters measure them; None without any."""
    params = DescriptorNet(dataset.path(DescriptorNet, variant=variant)).manifest.params
    if params.get("loss") != "contrastive":
        return None
    return {name: unit * float(params[f"margin_{name}"]) for name in ("foreground", "background")}


def _digests(dataset: Dataset, variants: Sequence[str], demonstrations: Sequence[str]) -> dict[str, str]:
    paths = [
        *(dataset.path(DescriptorNet, variant=name) for name in variants),
        *(dataset.path(kind, name) for name in demonstrations for kind in (Demonstration, Truth)),
    ]
    return {path.relative_to(dataset.root).as_posix(): _digest(path) for path in paths}


def _digest(path: Path) -> str:
    from bask_data.artifact import MANIFEST, Artifact

    return Artifact(path).manifest.digest if (path / MANIFEST).exists() else ""


# Tracking ------------------------------------------------------------------------------------------------------------


def _references(
    dataset: Dataset, network: DescriptorNetwork, picks: Sequence[Pick], folder: Path
) -> ReferenceKeypoints:
    """The points as a network describes them where they were picked."""
    import numpy as np

    found = []
    for pick in picks:
        picked_in = whole(dataset, pick.recording)
        assert picked_in is not None, "points are picked where truth is"
        image = picked_in.recording.camera(pick.camera).rgb(pick.frame)
        uv = np.array([[pick.u, pick.v]], dtype=np.float32)
        found.append(network.descriptors_at(image, uv)[0].cpu().numpy())
    ReferenceKeypoints.write(folder, descriptors=np.stack(found), picks=list(picks))
    return ReferenceKeypoints(folder)


def _tracked(
    dataset: Dataset,
    name: str,
    asked: Sequence[str],
    picks: Sequence[Pick],
    networks: Mapping[str, DescriptorNetwork],
    references: Mapping[str, ReferenceKeypoints],
    methods: Sequence[Method],
    seed: int,
) -> Tracked:
    """One pass over a demonstration's frames, each described once by each network and tracked as `encode` does."""
    import numpy as np

    one = whole(dataset, name)
    assert one is not None, "asked only where there is truth"
    demonstration = one.recording
    assert isinstance(demonstration, Demonstration), "asked only of demonstrations"
    cameras = cameras_of(demonstration, tuple(asked))
    tracked = _with_truth(dataset, name, cameras, picks, one.truth)
    trackers = {
        method.name: KeypointTracker(
            networks[method.variant],
            references[method.variant],
            method.settings,
            seed,
            cameras=tracked.cameras,
        )
        for method in methods
    }
    grippers, found = (
        grippers_of(demonstration, len(tracked.places)),
        {name: list[TrackedKeypoints]() for name in trackers},
    )
    for i_frame in progress(range(len(tracked.places)), f"tracking in {name}"):
        moment = moment_of(cameras, i_frame)
        for variant in networks:
            mine = [method.name for method in methods if method.variant == variant]
            look = trackers[mine[0]].look(*moment)
            _count(tracked, variant, one.truth, look.observations[cameras[0].name].distance, i_frame)
            for method in mine:
                found[method].append(trackers[method].update(look, None if grippers is None else grippers[i_frame]))
    for method, keypoints in found.items():
        tracked.mean[method] = np.stack([one.mean for one in keypoints])
        tracked.mode[method] = np.stack([one.mode for one in keypoints])
        tracked.pixel[method] = np.stack([np.stack([*one.pixel.values()]) for one in keypoints])
    return tracked


def _with_truth(dataset: Dataset, name: str, cameras: Sequence[Camera], picks: Sequence[Pick], truth: Truth) -> Tracked:
    """A demonstration that nothing is tracked in yet, and what its cameras see of the points."""
    import numpy as np

    from bask_data.core.keypoint_scores import sighting

    places = true_tracks(dataset, picks, name)
    found = [
        [true_pixels(point, camera, truth, i) for i, point in enumerate(places[: camera.n_frames])]
        for camera in cameras
    ]
    inside, hidden = (
        np.array([[getattr(frame, what) for frame in frames] for frames in found]) for what in ("inside", "hidden")
    )
    uv = np.array([[frame.uv for frame in frames] for frames in found])
    return Tracked(name, [camera.name for camera in cameras], places, sighting(inside, hidden, places), uv)


def _coarse(maps: np.ndarray) -> np.ndarray:
    """Maps (k, h, w) at `MAP_SIZE` pixels of width, or as they are."""
    import cv2
    import numpy as np

    height, width = maps.shape[1:]
    if width <= MAP_SIZE:
        return maps
    size = (MAP_SIZE, max(round(height * MAP_SIZE / width), 1))
    return np.stack([cv2.resize(one, size, interpolation=cv2.INTER_AREA) for one in maps])


def _count(tracked: Tracked, variant: str, truth: Truth, distance: np.ndarray, i_frame: int) -> None:
    """Add the first camera's distance maps (k, h, w) of the keypoints it shows to the histograms: pixels near the
    keypoint, of other objects and of none. Keep the first frame's."""
    import numpy as np

    from bask_data.core.geometry import pixel_grid, scale_pixels
    from bask_data.core.keypoint_scores import z_counts, z_edges
    from bask_data.kinds.truth import ROBOT

    if i_frame == 0:
        tracked.first_maps[variant] = _coarse(distance)
    if i_frame % HISTOGRAM_EVERY:
        return
    labels = truth.instance(tracked.cameras[0], i_frame)
    uv = scale_pixels(tracked.uv[0, i_frame], labels.shape, distance.shape[1:])
    shown = np.flatnonzero(tracked.seen.visible[i_frame] & np.isfinite(uv).all(axis=1))
    height, width = distance.shape[1:]
    away = np.linalg.norm(pixel_grid(height, width)[None] - uv[shown, None, None], axis=3)
    near = away <= NEAR * np.hypot(height, width)
    v, u = (np.arange(n) * size // n for n, size in zip((height, width), labels.shape, strict=True))
    on_object = np.isin(labels[np.ix_(v, u)], (0, ROBOT), invert=True)[None] & ~near
    groups = {"near": near, "objects": on_object, "background": ~near & ~on_object}
    counts = tracked.counts.setdefault(variant, {})
    for group, found in z_counts(distance[shown], groups, z_edges()).items():
        counts[group] = counts.get(group, 0) + found


# Telling --------------------------------------------------------------------------------------------------------------


def _told(
    picks: Sequence[Pick], objects: Sequence[str], tracks: Sequence[Tracked], methods: Sequence[Method]
) -> dict[str, Any]:
    """Figures over the keypoints and demonstrations of one set of objects."""
    import numpy as np

    from bask_data.core.keypoint_scores import PHASES, phases, share_over_time, z_edges

    of_frames = [phases(one.places, one.seen) for one in tracks]
    return {
        "demonstrations": {one.name: {"cameras": one.cameras, "n_frames": len(one.places)} for one in tracks},
        "keypoints": [
            {"object": name, **pick.model_dump(exclude={"instance", "point_world"})}
            for pick, name in zip(picks, objects, strict=True)
        ],
        "moments": np.linspace(0.0, 1.0, N_MOMENTS).tolist(),
        "share_of": {
            phase: _plain(share_over_time([found[phase] for found in of_frames], N_MOMENTS)) for phase in PHASES
        },
        "methods": {one.name: _told_method(one.name, picks, objects, tracks, of_frames) for one in methods},
        "distances": {
            "edges": z_edges().tolist(),
            "counts": {
                variant: {
                    group: np.sum([one.counts[variant][group] for one in tracks if variant in one.counts], axis=0)
                    .astype(int)
                    .tolist()
                    for group in ("near", "objects", "background")
                }
                for variant in dict.fromkeys(one.variant for one in methods)
            },
        },
        "examples": _examples(objects, tracks, methods),
    }


def _told_method(
    name: str,
    picks: Sequence[Pick],
    objects: Sequence[str],
    tracks: Sequence[Tracked],
    of_frames: Sequence[Mapping[str, np.ndarray]],
) -> dict[str, Any]:
    import numpy as np

    from bask_data.core.keypoint_scores import PHASES, Errors, distances, errors, over_time

    known_places = [np.isfinite(one.places).all(axis=2) for one in tracks]
    error = [distances(one.mean[name], one.places) for one in tracks]
    of_mode = [distances(one.mode[name], one.places) for one in tracks]
    apart = [distances(one.mean[name], one.mode[name]) for one in tracks]

    def told(values: Sequence[np.ndarray], chosen: Sequence[np.ndarray]) -> dict[str, float | int | None]:
        figures: Errors = errors(values, chosen)
        return {key: None if value != value else value for key, value in asdict(figures).items()}

    def of_keypoints(mine: np.ndarray) -> list[np.ndarray]:
        return [known & mine for known in known_places]

    def split(values: Sequence[np.ndarray]) -> dict[str, dict[str, float | int | None]]:
        return {
            "all": told(values, known_places),
            **{phase: told(values, [found[phase] for found in of_frames]) for phase in PHASES},
        }

    object_of = np.array(objects)
    along = {"error": over_time(error, N_MOMENTS), "apart": over_time(apart, N_MOMENTS)}
    return {
        "error": split(error),
        "error_of_mode": split(of_mode),
        "apart": split(apart),
        "by_object": {one: told(error, of_keypoints(object_of == one)) for one in dict.fromkeys(objects)},
        "by_keypoint": {
            pick.name: told(error, of_keypoints(np.arange(len(picks)) == i)) for i, pick in enumerate(picks)
        },
        "by_demonstration": {
            one.name: told([mine], [there]) for one, mine, there in zip(tracks, error, known_places, strict=True)
        },
        "over_time": {
            f"{what}_{figure}": _plain(getattr(found, figure))
            for what, found in along.items()
            for figure in ("mean", "deviation")
        },
    }


def _examples(objects: Sequence[str], tracks: Sequence[Tracked], methods: Sequence[Method]) -> list[dict[str, Any]]:
    """Of each object, one keypoint in some frames of the first demonstration: the median one of the last method, so
    that it is neither the best nor the worst that is shown."""
    import numpy as np

    from bask_data.core.keypoint_scores import distances

    one, last = tracks[0], methods[-1].name
    error = distances(one.mean[last], one.places)
    frames = np.linspace(0, len(error) - 1, min(N_EXAMPLE_FRAMES, len(error))).round().astype(int)
    examples = []
    for name in dict.fromkeys(objects):
        known_ones = [i for i, other in enumerate(objects) if other == name and np.isfinite(error[:, i]).any()]
        if not known_ones:
            continue
        i = sorted(known_ones, key=lambda i: float(np.nanmean(error[:, i])))[len(known_ones) // 2]
        examples.append(
            {
                "demonstration": one.name,
                "camera": one.cameras[0],
                "object": name,
                "keypoint": i,
                "frames": frames.tolist(),
                "truth": [_plain(one.uv[0, t, i]) for t in frames],
                "visible": [bool(one.seen.visible[t, i]) for t in frames],
                "first_map": {variant: [_plain(row) for row in maps[i]] for variant, maps in one.first_maps.items()},
                "pixel": {method.name: [_plain(one.pixel[method.name][t, 0, i]) for t in frames] for method in methods},
                "error": {
                    method.name: _plain(distances(one.mean[method.name], one.places)[frames, i]) for method in methods
                },
            }
        )
    return examples


def _plain(values: np.ndarray) -> list[float | None]:
    """Numbers for JSON, which knows no NaN, to a tenth of a millimetre or less."""
    return [None if value != value else round(value, 5) for value in values.tolist()]
