"""Figures of the artifacts of one scene or demonstration: recordings, reconstructions, objects, masks and matches."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from bask_data.core.label_overlap import best_instances
from bask_data.core.scores import distribution
from bask_data.evaluation.lookup import spread_frames
from bask_data.evaluation.masks import count_masks, label_groups
from bask_data.kinds import Camera, Correspondences, ObjectInstances, Reconstruction, Recording, Truth, VisibleMasks
from bask_data.kinds.truth import ROBOT

SHARED_IOU = 0.05
"""IoU from which an instance covers a label; an instance that covers two labels has merged their objects."""
MOST_MEASURED = 300
"""Frames of a camera in which masks are counted and compared with labels, at most, evenly spaced."""
N_SAMPLED = 8
"""Frames of a camera that are sampled for rough figures."""


def recording_figures(recording: Recording | None) -> dict[str, Any]:
    """Frames, size, duration, camera path and depth of each camera."""
    if recording is None:
        return {}
    return {camera.name: _camera_figures(camera) for camera in recording.cameras}


def is_still(camera: Camera) -> bool:
    """Whether all poses of a camera are the same."""
    return bool((camera.world_from_cameras == camera.world_from_cameras[:1]).all())


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
        "depth_m": distribution(all_depths),
        "depth_range_m": [float(x) for x in np.percentile(all_depths, [2, 98])] if len(all_depths) else [0.0, 1.0],
        "is_still": is_still(camera),
    }


def reconstruction_figures(reconstruction: Reconstruction | None) -> dict[str, Any]:
    """Size of the mesh, quality of the fusion, and suspect frames."""
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
    """The table of instances, the planes treated as background, and objects that nearly touch."""
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
    """Visible share of each instance and, with labels, each label's IoU with its best instance over all frames.

    Labels of touching objects count as one, and the robot's as background, which no mask should cover.
    """
    if masks is None:
        return {}
    cameras = [masks.camera(name) for name in masks.camera_names]
    visible, certain = ([getattr(camera, f"{what}_fraction") for camera in cameras] for what in ("visible", "measured"))
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
                "visible_fraction": distribution(known),
                "measured_fraction": distribution(certain[:, i]),
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
    matches = best_instances(table)
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
    """Numbers of matches, differences between the views of pairs, and reasons for rejection."""
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
        "matches_per_pair": distribution(column["n_matches"].astype(np.float64)),
        "distance_m": distribution(column["distance"]),
        "angle_deg": distribution(np.rad2deg(column["angle"])),
        "scale": distribution(change.scale),
        "rotation_deg": distribution(np.rad2deg(change.rotation)),
        "matches_per_instance": {int(row["values"]): int(row["counts"]) for row in sorted(counts, key=_instance)},
        "rejections": dict(correspondences.metadata.rejections),
        "rejections_per_instance": _rejections(correspondences),
        "warnings": list(correspondences.metadata.warnings),
    }


@dataclass(frozen=True)
class ViewChanges:
    """How the matched surface changes from the first image to the second, by pair with matches.

    Args:
        scale: factor of enlargement.
        rotation: rotation in the image, radians.
    """

    scale: np.ndarray
    rotation: np.ndarray


def view_changes(matches: Any) -> ViewChanges:
    """The least-squares similarity between the matched pixels of each pair."""
    _, pair = np.unique(matches["pair"].to_numpy(), return_inverse=True)
    a, b = (matches[f"u_{x}"].to_numpy() + 1j * matches[f"v_{x}"].to_numpy().astype(np.float64) for x in "ab")

    def total(values: np.ndarray) -> np.ndarray:
        return np.bincount(pair, values.real) + 1j * np.bincount(pair, values.imag)

    n = np.bincount(pair)
    a, b = (z - (total(z) / np.maximum(n, 1))[pair] for z in (a, b))
    spread = total(np.abs(a) ** 2 + 0j).real
    # Matches at one point determine neither scale nor rotation.
    known = (n >= 2) & (spread > n)
    factor = total(a.conj() * b)[known] / spread[known]
    return ViewChanges(np.abs(factor), np.angle(factor))


def _rejections(correspondences: Correspondences) -> dict[int, dict[str, int]]:
    """Rejected pixels by object and reason."""
    table = correspondences.rejections().group_by(["instance", "reason"]).aggregate([("n", "sum")])
    counts: dict[int, dict[str, int]] = {}
    for row in sorted(table.to_pylist(), key=lambda row: (row["instance"], row["reason"])):
        counts.setdefault(int(row["instance"]), {})[str(row["reason"])] = int(row["n_sum"])
    return counts


def _instance(row: dict[str, int]) -> int:
    return row["values"]
