"""The figures of a report: artifacts opened, held against each other by `core.scores`, and put in plain values."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, is_dataclass
from functools import cached_property
from typing import Any, TypeVar

import numpy as np

from bask_data.artifact import MANIFEST, Artifact, Manifest, read_json
from bask_data.core import scores
from bask_data.core.keypoint_scores import distances
from bask_data.dataset import Dataset
from bask_data.errors import BadData, BaskError
from bask_data.evaluation.keypoint_study import FILE
from bask_data.evaluation.masks import count_masks, label_groups
from bask_data.evaluation.places import known, known_of, places_of
from bask_data.kinds import (
    KINDS,
    Camera,
    Correspondences,
    DescriptorNet,
    KeypointTrack,
    ObjectInstances,
    Pick,
    Reconstruction,
    Recording,
    ReferenceKeypoints,
    Truth,
    VisibleMasks,
)
from bask_data.kinds.places import object_poses, picked_label
from bask_data.kinds.truth import ROBOT

TOLERANCE_PX = 5.0
"""A keypoint this close to its object counts as near: labels drawn by people are not better than that."""
SHARED_IOU = 0.05
"""Below this, an instance only touches a label; two labels it covers better than this were not told apart."""
MOST_MEASURED = 300
"""Frames of a camera in which masks are counted and held against labels; of more, so many spread evenly."""
MOST_NETWORKS = 5
"""Descriptor networks compared: one a preset, and one more."""
PAIRS_EVALUATED, SCENES_EVALUATED = 48, 8
"""Pairs of frames on which networks are compared, shared among so many scenes at most: enough for an impression, and a
report is made in a minute. `bask-data evaluate descriptor` takes more."""
N_SAMPLED = 8
"""Frames looked at for figures that need no more than an impression."""

A = TypeVar("A", bound=Artifact)

UNREADABLE = (BaskError, LookupError, ValueError, ArithmeticError)
"""What artifacts raise that are broken or do not belong together: frames or columns missing, shapes that differ.
A report is where a person looks to find that out, so it says so and goes on."""


def what_is_wrong(error: Exception) -> str:
    """The error in words; those that are not ours do not say what they are of themselves."""
    return str(error) if isinstance(error, BaskError) else f"{type(error).__name__}: {error}"


def find(dataset: Dataset, kind: type[A], item: str = "", variant: str = "main") -> A | None:
    """The artifact, or None if it was not made."""
    path = dataset.path(kind, item, variant)
    return kind(path) if (path / MANIFEST).exists() else None


def find_recording(dataset: Dataset, item: str) -> Recording | None:
    """A scan or demonstration by name; None for names that are no item, as those in strangers' files may be."""
    found = known(dataset, item)
    return None if found is None else found.recording


def find_truth(dataset: Dataset, item: str) -> Truth | None:
    """The ground truth of a recording, if there is one."""
    return find(dataset, Truth, item) if item in dataset.items("recording") else None


def spread_frames(n_frames: int, n_wanted: int) -> list[int]:
    """Frames spread evenly from the first to the last."""
    return sorted({int(i) for i in np.linspace(0, n_frames - 1, min(n_wanted, n_frames)).round()}) if n_frames else []


def plain(value: Any) -> Any:
    """The value in JSON's terms: dataclasses as objects, what is not finite as None."""
    if is_dataclass(value) and not isinstance(value, type):
        return plain(asdict(value))
    if isinstance(value, dict):
        return {str(key): plain(one) for key, one in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(one) for one in value]
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, np.generic):
        return plain(value.item())
    return None if isinstance(value, float) and not math.isfinite(value) else value


class Measured:
    """Figures that take a look at many frames: taken once for a page, in whatever size, and for its summary."""

    def __init__(self, dataset: Dataset) -> None:
        self._dataset = dataset
        self._masks: dict[str, dict[str, Any]] = {}
        self._tracks: dict[tuple[str, str], TrackScores] = {}
        self._descriptors: dict[str, Any] | None = None

    def masks(self, scene: str) -> dict[str, Any]:
        """Of a scene's masks; what cannot be read says why."""
        if scene not in self._masks:
            try:
                found = masks_figures(find(self._dataset, VisibleMasks, scene), find_truth(self._dataset, scene))
            except UNREADABLE as error:
                found = {"error": what_is_wrong(error)}
            self._masks[scene] = found
        return self._masks[scene]

    def descriptors(self) -> dict[str, Any]:
        """What `evaluate descriptor` tells of the first few networks, on few pairs; `errors` says what cannot be read
        or measured. Empty without any network."""
        if self._descriptors is None:
            self._descriptors = descriptors_figures(self._dataset)
        return self._descriptors

    def track(self, demonstration: str, variant: str) -> TrackScores:
        """Of a track that exists."""
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
    """The sets of objects of the dataset's last study of keypoints; a file that is none the page complains of."""
    try:
        return list(read_json(dataset.root / FILE)["groups"]) if (dataset.root / FILE).exists() else []
    except (*UNREADABLE, TypeError):
        return []


def _study_figures(dataset: Dataset, name: str) -> dict[str, Any]:
    """Of each method: errors, and the distance between mean and mode, by what the cameras see."""
    methods = read_json(dataset.root / FILE)["groups"][name]["methods"]
    return {method: {what: told[what] for what in ("error", "apart")} for method, told in methods.items()}


def _each(names: Sequence[str], figures: Any) -> dict[str, Any]:
    """Figures by name, without those that have none; what cannot be read says why."""
    found: dict[str, Any] = {}
    for name in names:
        try:
            value = figures(name)
        except UNREADABLE as error:
            value = {"error": what_is_wrong(error)}
        if value:
            found[name] = value
    return found


@dataclass(frozen=True)
class MadeArtifact:
    """One line of the list of what was made; `seconds` and `peak_bytes` are None where no record was kept."""

    artifact: str
    made_by: str
    bytes: int
    digest: str
    seconds: float | None
    peak_bytes: int | None
    time: str


def made(dataset: Dataset) -> list[MadeArtifact]:
    """Every artifact of the dataset that exists, in the order of the stages."""
    found = []
    for kind in KINDS:
        items = [""] if kind.scope == "dataset" else dataset.items(kind.scope)
        for variant in dataset.variants(kind):
            for item in items:
                artifact = find(dataset, kind, item, variant)
                if artifact is not None:
                    found.append(_made(dataset, artifact))
    return found


def _made(dataset: Dataset, artifact: Artifact) -> MadeArtifact:
    relative = artifact.path.relative_to(dataset.root)
    try:
        manifest = artifact.manifest
    except BadData:
        return MadeArtifact(relative.as_posix(), "unreadable manifest", 0, "", None, None, "")
    record: Any = {}
    file = dataset.root / "provenance" / relative.parent / f"{relative.name}.json"
    if file.exists():
        try:
            record = read_json(file)
        except BadData:
            record = {}
    # A record of an earlier making says nothing of this one.
    record = record if isinstance(record, dict) and record.get("key") == manifest.key else {}
    seconds, peak = record.get("seconds"), record.get("process_peak_bytes")
    return MadeArtifact(
        artifact=relative.as_posix(),
        made_by=f"{manifest.stage} v{manifest.stage_version}",
        bytes=sum(entry.bytes for entry in manifest.files.values()),
        digest=manifest.digest,
        seconds=float(seconds) if isinstance(seconds, (int, float)) else None,
        peak_bytes=int(peak) if isinstance(peak, (int, float)) else None,
        time=str(record.get("time", "")),
    )


def recording_figures(recording: Recording | None) -> dict[str, Any]:
    """Frames, size, duration, camera path and depth of each camera."""
    if recording is None:
        return {}
    return {camera.name: _camera_figures(camera) for camera in recording.cameras}


def _camera_figures(camera: Camera) -> dict[str, Any]:
    measured, depths = [], []
    for i_frame in spread_frames(camera.n_frames, N_SAMPLED):
        depth = camera.depth(i_frame)
        measured.append(float((depth > 0).mean()))
        depths.append(depth[depth > 0][::17])
    all_depths = np.concatenate(depths) if depths else np.zeros(0, np.float32)
    steps = np.linalg.norm(np.diff(camera.world_from_cameras[:, :3, 3], axis=0), axis=1)
    return {
        "n_frames": camera.n_frames,
        "width": camera.width,
        "height": camera.height,
        "seconds": float(camera.time[-1] - camera.time[0]) if camera.n_frames else 0.0,
        "path_m": float(steps.sum()),
        "depth_share": float(np.mean(measured)) if measured else math.nan,
        "depth_m": scores.distribution(all_depths),
        "depth_range_m": [float(x) for x in np.percentile(all_depths, [2, 98])] if len(all_depths) else [0.0, 1.0],
    }


def reconstruction_figures(reconstruction: Reconstruction | None) -> dict[str, Any]:
    """Size of the mesh, what the fusion says of its quality, and the frames that stand out."""
    if reconstruction is None:
        return {}
    metadata, frames = reconstruction.metadata, reconstruction.frames
    low, high = np.array(metadata.bounds).reshape(2, 3)
    suspect = frames.filter(frames["suspect"]).select(["camera", "frame", "residual_abs", "explained"])
    return {
        "n_vertices": len(reconstruction.vertices),
        "n_triangles": len(reconstruction.triangles),
        "voxel_size_m": reconstruction.voxel_size,
        "bounds_m": [low.tolist(), high.tolist()],
        "quality": metadata.quality.model_dump(),
        "suspect_frames": suspect.to_pylist(),
        "unmeasured": [region.model_dump() for region in metadata.unmeasured],
        "warnings": list(metadata.warnings),
    }


def objects_figures(objects: ObjectInstances | None) -> dict[str, Any]:
    """The table of instances, the planes taken for background, and objects that nearly touch."""
    if objects is None:
        return {}
    return {
        "n_objects": len(objects.instances),
        "background_share": float((objects.vertex_instance == 0).mean()) if len(objects.vertex_instance) else math.nan,
        "instances": [row.model_dump() for row in objects.instances],
        "planes": [row.model_dump() for row in objects.metadata.planes],
        "neighbours": [row.model_dump() for row in objects.metadata.neighbours],
        "warnings": list(objects.metadata.warnings),
    }


def masks_figures(masks: VisibleMasks | None, truth: Truth | None) -> dict[str, Any]:
    """How visible each instance is, and, with labels, each one's IoU with its best instance over all frames.

    Labels of bodies that touch count as one, and the robot's as background: no mask may lie on it.
    """
    if masks is None:
        return {}
    cameras = [masks.camera(name) for name in masks.camera_names]
    visible, certain = ([getattr(one, f"{what}_fraction") for one in cameras] for what in ("visible", "measured"))
    counts = count_masks(masks, truth, lambda n: spread_frames(n, MOST_MEASURED))
    none, n_labelled = np.zeros((0, 0)), counts.n_labelled_pixels
    return {
        "n_frames": sum(camera.n_frames for camera in cameras),
        "n_measured_frames": counts.n_frames,
        "pixels": dict(masks.metadata.pixels),
        "noise": dict(masks.metadata.noise),
        "tolerance": dict(masks.metadata.tolerance),
        "instances": _visibility(
            np.concatenate(visible) if visible else none, np.concatenate(certain) if certain else none, counts.n_pixels
        ),
        "labels": _label_matches(counts.table, truth) if truth is not None and counts.n_labelled_frames else None,
        "n_labelled_frames": counts.n_labelled_frames,
        "on_robot_share": counts.n_on_robot / n_labelled
        if truth and ROBOT in truth.label_names and n_labelled
        else None,
    }


def _visibility(fraction: np.ndarray, certain: np.ndarray, n_pixels: np.ndarray) -> list[dict[str, Any]]:
    rows = []
    for i in range(fraction.shape[1]):
        known = fraction[:, i][np.isfinite(fraction[:, i])]
        rows.append(
            {
                "id": i + 1,
                "n_frames_in_view": len(known),
                "n_frames_seen": int((known > 0).sum()),
                "visible_fraction": scores.distribution(known),
                "measured_fraction": scores.distribution(certain[:, i]),
                "least_visible": float(known.min()) if len(known) else math.nan,
                "n_pixels": int(n_pixels[i + 1]) if i + 1 < len(n_pixels) else 0,
            }
        )
    return rows


def _label_matches(table: np.ndarray, truth: Truth) -> list[dict[str, Any]]:
    groups = label_groups(truth)
    names: dict[int, list[str]] = {}
    for label, name in sorted(truth.label_names.items()):
        if 0 < label < len(groups):
            names.setdefault(int(groups[label]), []).append(name)
    matches = scores.best_instances(table)
    taken = [match.instance for match in matches if match.iou >= SHARED_IOU]
    return [
        {
            **asdict(match),
            "name": " + ".join(names.get(match.label, [])) or f"label {match.label}",
            "shared": match.iou >= SHARED_IOU and taken.count(match.instance) > 1,
        }
        for match in matches
    ]


def matches_figures(correspondences: Correspondences | None) -> dict[str, Any]:
    """How many matches, between how different views, and why candidates were rejected."""
    if correspondences is None:
        return {}
    pairs, matches = correspondences.pairs(), correspondences.matches()
    column = {name: pairs[name].to_numpy() for name in ("n_attempts", "n_matches", "distance", "angle")}
    counts = matches["instance"].value_counts().to_pylist()
    attempts = int(column["n_attempts"].sum())
    change = view_changes(matches)
    return {
        "n_pairs": pairs.num_rows,
        "n_matches": int(column["n_matches"].sum()),
        "n_attempts": attempts,
        "accepted_share": int(column["n_matches"].sum()) / attempts if attempts else math.nan,
        "n_pairs_without_match": int((column["n_matches"] == 0).sum()),
        "matches_per_pair": scores.distribution(column["n_matches"].astype(np.float64)),
        "distance_m": scores.distribution(column["distance"]),
        "angle_deg": scores.distribution(np.rad2deg(column["angle"])),
        "scale": scores.distribution(change.scale),
        "rotation_deg": scores.distribution(np.rad2deg(change.rotation)),
        "matches_per_instance": {int(row["values"]): int(row["counts"]) for row in sorted(counts, key=_instance)},
        "rejections": dict(correspondences.metadata.rejections),
        "rejections_per_instance": _rejections(correspondences),
        "warnings": list(correspondences.metadata.warnings),
    }


@dataclass(frozen=True)
class ViewChanges:
    """By pair with matches, how the second image shows the matched surface, against the first.

    Args:
        scale: larger by this factor.
        rotation: turned in the image by this angle, radians.
    """

    scale: np.ndarray
    rotation: np.ndarray


def view_changes(matches: Any) -> ViewChanges:
    """The similarity that fits the matches of each pair best, in the sense of least squares."""
    _, pair = np.unique(matches["pair"].to_numpy(), return_inverse=True)
    a, b = (matches[f"u_{x}"].to_numpy() + 1j * matches[f"v_{x}"].to_numpy().astype(np.float64) for x in "ab")

    def total(values: np.ndarray) -> np.ndarray:
        return np.bincount(pair, values.real) + 1j * np.bincount(pair, values.imag)

    n = np.bincount(pair)
    a, b = (z - (total(z) / np.maximum(n, 1))[pair] for z in (a, b))
    spread = total(np.abs(a) ** 2 + 0j).real
    # A pair of matches in one place says nothing of scale or rotation.
    known = (n >= 2) & (spread > n)
    factor = total(a.conj() * b)[known] / spread[known]
    return ViewChanges(np.abs(factor), np.angle(factor))


def _rejections(correspondences: Correspondences) -> dict[int, dict[str, int]]:
    """Rejected pixels by object and reason."""
    table = correspondences.rejections().group_by(["instance", "reason"]).aggregate([("n", "sum")])
    found: dict[int, dict[str, int]] = {}
    for row in sorted(table.to_pylist(), key=lambda row: (row["instance"], row["reason"])):
        found.setdefault(int(row["instance"]), {})[str(row["reason"])] = int(row["n_sum"])
    return found


def _instance(row: dict[str, int]) -> int:
    return row["values"]


def descriptor_figures(descriptor: DescriptorNet | None) -> dict[str, Any]:
    """What the network was validated on, and how well it did."""
    if descriptor is None:
        return {}
    steps = descriptor.curve()["step"].to_numpy()
    return {
        "validated_on": descriptor.metadata.validated_on,
        "metrics": dict(descriptor.metadata.metrics),
        "n_steps": int(steps.max()) if len(steps) else 0,
        "step": descriptor.metadata.step,
        "chosen_by": descriptor.metadata.chosen_by,
        "model": {key: value for key, value in descriptor.model.items() if isinstance(value, (str, int, float, bool))},
    }


def networks(dataset: Dataset) -> dict[str, DescriptorNet]:
    """The first few descriptor networks by variant."""
    found = {variant: find(dataset, DescriptorNet, "", variant) for variant in dataset.variants(DescriptorNet)}
    there = [(variant, one) for variant, one in found.items() if one is not None]
    return dict(there[:MOST_NETWORKS])


def descriptors_figures(dataset: Dataset) -> dict[str, Any]:
    """How well networks find in held-out views what they saw in others, on the same few pairs."""
    from bask_data.evaluation import evaluated_descriptor
    from bask_data.evaluation.held_out import held_out

    readable, errors = [], {}
    for variant, network in networks(dataset).items():
        try:
            network.network()
            readable.append(variant)
        except BadData as error:
            errors[variant] = what_is_wrong(error)
    found: dict[str, Any] = {}
    try:
        if readable:
            scenes = held_out(dataset, readable).scenes
            n_pairs = max(PAIRS_EVALUATED // min(len(scenes), SCENES_EVALUATED), 1)
            some = scenes[:SCENES_EVALUATED] if len(scenes) > SCENES_EVALUATED else ()
            found = evaluated_descriptor(dataset, readable, scenes=some, pairs=n_pairs, sweep=True)
    except UNREADABLE as error:
        errors["not measured"] = what_is_wrong(error)
    return {**found, **({"errors": errors} if errors else {})}


def input_path(manifest: Manifest, kind: type[Artifact]) -> str | None:
    """Where in the dataset an artifact's input of a kind lay, by its manifest."""
    return next((path for path in sorted(manifest.inputs) if path.split("/")[0] == kind.kind), None)


def input_variant(dataset: Dataset, artifact: Artifact, kind: type[A], fallback: str) -> A | None:
    """The dataset-wide input that an artifact was made from, or that of the fallback variant if no record says."""
    path = input_path(artifact.manifest, kind)
    variant = path.split("/")[1] if path and path.count("/") == 1 else fallback
    return find(dataset, kind, "", variant if variant in dataset.variants(kind) else fallback)


class TrackScores:
    """A track held against the ground truth of its demonstration, as far as there is one."""

    def __init__(self, dataset: Dataset, demonstration: str, variant: str) -> None:
        track = find(dataset, KeypointTrack, demonstration, variant)
        assert track is not None, "asked only for tracks that exist"
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
        """The pick of each keypoint, by name; None where the reference does not have it."""
        by_name = {pick.name: pick for pick in self.reference.picks} if self.reference else {}
        return [by_name.get(name) for name in self.track.names]

    @cached_property
    def picked_labels(self) -> list[int]:
        """True label of what each keypoint was picked on: 0 is background, -1 unknown."""
        picked = [pick for pick in self.picks if pick]
        known = known_of(self._dataset, picked)
        here = [pick for pick in picked if pick.recording in known]
        found = {pick.name: picked_label(pick, known[pick.recording].truth) for pick in here}
        return [found.get(name, -1) for name in self.track.names]

    @cached_property
    def labels(self) -> np.ndarray:
        """Object label of each keypoint; 0 where unknown or background."""
        return np.array([max(label, 0) for label in self.picked_labels], dtype=np.int64)

    @cached_property
    def places(self) -> np.ndarray:
        """Where each keypoint truly is in each frame (t, k, 3), metres, world; NaN where not known."""
        n, k = len(self.track.mean), len(self.track.names)
        places, indices = np.full((n, k, 3), np.nan), [i for i, pick in enumerate(self.picks) if pick]
        if self.recording is not None and indices:
            found = places_of(self._dataset, [pick for pick in self.picks if pick], self.recording.path.name)[:n]
            places[: len(found), indices] = found
        return places

    @cached_property
    def with_place(self) -> np.ndarray:
        """(k,) bool: keypoints whose place is known, in some frame at least."""
        return np.isfinite(self.places).all(axis=2).any(axis=0)

    @cached_property
    def error(self) -> np.ndarray:
        """(t, k) metres; NaN where not known."""
        return distances(self.track.mean, self.places)

    @cached_property
    def spread(self) -> np.ndarray:
        """(t, k) metres."""
        return scores.spread(self.track.covariance)

    @cached_property
    def landings(self) -> dict[str, list[scores.Landing]]:
        """Per camera with labels, where the keypoints lie in each frame."""
        truth = self.truth
        if truth is None or not self.labels.any():
            return {}
        sizes = (
            {camera.name: (camera.height, camera.width) for camera in self.recording.cameras} if self.recording else {}
        )
        return {
            camera: [
                scores.landing(pixel, self.labels, _checked(truth, camera, i_frame, sizes.get(camera)), TOLERANCE_PX)
                for i_frame, pixel in enumerate(self.track.pixel(camera))
            ]
            for camera in self.track.camera_names
            if camera in truth.camera_names
        }

    @property
    def all_landings(self) -> list[scores.Landing]:
        """Of all cameras and frames."""
        return [one for landings in self.landings.values() for one in landings]

    def why_no_error(self) -> str:
        """Why there is no error against the truth, in words; empty when there is one."""
        if self.with_place.any():
            return ""
        if self.truth is None:
            return "there is no ground truth for this demonstration"
        if self.reference is None:
            return "the reference keypoints it was made from are gone"
        if not self.labels.any():
            return "the reference keypoints were picked on no labelled object"
        if not object_poses(self.truth):
            return "the ground truth of this demonstration does not say where its objects stand"
        return "no object that a keypoint was picked on has a known place in both recordings"

    def why_no_share(self) -> str:
        """Why there is no share on the right object, in words; empty when there is one."""
        if self.truth is None:
            return "there is no ground truth for this demonstration"
        if not self.labels.any():
            return "no label is known for any reference keypoint's object"
        if not self.landings:
            return "the ground truth labels none of the track's cameras"
        if not any(one.in_view.any() for one in self.all_landings):
            return "no keypoint's object is in view by the labels"
        return ""


def _checked(truth: Truth, camera: str, i_frame: int, size: tuple[int, int] | None) -> np.ndarray:
    """The labels of a frame, which must be as large as its image: pixels mean nothing else."""
    labels = truth.instance(camera, i_frame)
    if size is not None and labels.shape != size:
        raise BadData(truth.path / camera / "instance", "shape", expected=f"{size} as the images", got=labels.shape)
    return labels


def track_figures(dataset: Dataset, measured: Measured, demonstration: str, variant: str) -> dict[str, Any]:
    """How certain, how steady and, where the truth is known, how right the keypoints of a demonstration are."""
    if find(dataset, KeypointTrack, demonstration, variant) is None:
        return {}
    return figures_of_track(measured.track(demonstration, variant))


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
        "error_m": scores.distribution(error),
        "error_last_frame_m": scores.distribution(error[-1:]),
        "n_keypoints_with_place": int(with_place.sum()),
        "within_2cm": _share_below(error, 0.02),
        "within_5cm": _share_below(error, 0.05),
        "why_no_error": scored.why_no_error(),
        "truth_error_m": {
            truth.label_names.get(label, str(label)): value
            for label, value in pose_error.items()
            if truth is not None and label in set(scored.labels[with_place].tolist())
        },
        "on_object": scores.object_shares(landings),
        "tolerance_px": TOLERANCE_PX,
        "why_no_share": scored.why_no_share(),
        "spread_m": scores.distribution(scored.spread),
        "step_m": scores.distribution(scores.step_length(track.mean)),
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
        "error_m": scores.distribution(scored.error[:, i]),
        "on_object": scores.object_shares(scored.all_landings, chosen),
        "spread_m": scores.distribution(scored.spread[:, i]),
        "localised_share": float(np.isfinite(scored.track.mean[:, i]).all(axis=1).mean()),
    }
