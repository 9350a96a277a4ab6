"""The top of the page: artifacts, headline figures, what is missing and what is not shown."""

from __future__ import annotations

from typing import Any, TypeVar

from bask_data.artifact import Artifact
from bask_data.dataset import Dataset
from bask_data.evaluation.label_matches import median_apart, merged_labels
from bask_data.evaluation.lookup import UNREADABLE, find, find_recording, find_truth
from bask_data.evaluation.made import made
from bask_data.evaluation.track_figures import figures_of_track
from bask_data.kinds import (
    Correspondences,
    DescriptorNet,
    KeypointTrack,
    ObjectInstances,
    Reconstruction,
    ReferenceKeypoints,
    VisibleMasks,
)
from bask_data.report.chosen import N_ROWS, Chosen, Part
from bask_data.report.words import count, millimetres, percent

A = TypeVar("A", bound=Artifact)


def overview(chosen: Chosen) -> Part:
    """Artifacts, headline figures, what is missing and what is not shown."""
    artifacts = made(chosen.dataset)
    return {
        "headline": _headline(chosen),
        "artifacts": artifacts[: 3 * N_ROWS],
        "n_artifacts_left_out": max(len(artifacts) - 3 * N_ROWS, 0),
        "seconds": sum(artifact.seconds or 0.0 for artifact in artifacts),
        "n_without_record": sum(artifact.seconds is None for artifact in artifacts),
        "bytes": sum(artifact.bytes for artifact in artifacts),
        "missing": _missing(chosen),
        "left_out": _left_out(chosen),
    }


def _left_out(chosen: Chosen) -> list[str]:
    sorts = [
        ("scenes", chosen.dataset.items("scene"), chosen.scenes),
        ("demonstrations", chosen.dataset.items("demonstration"), chosen.demonstrations),
    ]
    return [
        f"{len(everything)} {sort}: {_named(shown, everything)} are shown, "
        f"{len(everything) - len(shown)} are left out; the figures below are for those shown."
        for sort, everything, shown in sorts
        if len(shown) < len(everything)
    ]


def _named(shown: list[str], everything: list[str]) -> str:
    return f"the first {len(shown)}" if shown == everything[: len(shown)] else ", ".join(shown)


def _missing(chosen: Chosen) -> list[str]:
    """Missing frames, ground truth and artifacts, in sentences."""
    dataset, sentences = chosen.dataset, []
    for name in [*chosen.scenes, *chosen.demonstrations]:
        if find_recording(dataset, name) is None:
            sentences.append(f"{name}: its frames are not in the dataset.")
        if find_truth(dataset, name) is None:
            sentences.append(f"No ground truth for {name}: no errors can be measured.")
    of_scenes: list[tuple[type[Artifact], str]] = [
        (Reconstruction, "reconstruction"),
        (ObjectInstances, "objects"),
        (VisibleMasks, "masks"),
        (Correspondences, "correspondences"),
    ]
    of_dataset: list[tuple[type[Artifact], str]] = [
        (DescriptorNet, "descriptor network"),
        (ReferenceKeypoints, "reference keypoints"),
    ]
    for kind, what in of_scenes:
        without = [name for name in chosen.scenes if not find(dataset, kind, name)]
        if without:
            sentences.append(f"No {what} yet: {', '.join(without)}.")
    if not chosen.scenes:
        sentences.append("No scan.")
    for kind, what in of_dataset:
        if not any(find(dataset, kind, "", variant) for variant in chosen.variants):
            sentences.append(f"No {what} yet.")
    without = [
        name
        for name in chosen.demonstrations
        if not any(find(dataset, KeypointTrack, name, variant) for variant in chosen.variants)
    ]
    if without:
        sentences.append(f"No keypoints yet: {', '.join(without)}.")
    if not chosen.demonstrations:
        sentences.append("No demonstration, so there is nothing to track keypoints in.")
    return sentences


def _headline(chosen: Chosen) -> list[tuple[str, str]]:
    """Headline figures (value, caption)."""
    dataset, rows = chosen.dataset, []
    n_frames = sum(camera.n_frames for name in chosen.scenes for camera in _cameras(dataset, name))
    if n_frames:
        rows.append((f"{n_frames:,}", f"frames scanned in {count(len(chosen.scenes), 'scene')}"))
    n_objects = [len(o.instances) for name in chosen.scenes if (o := _readable(find(dataset, ObjectInstances, name)))]
    if n_objects:
        rows.append((f"{sum(n_objects)}", "objects found"))
    labels = [label for figures in chosen.masks.values() for label in figures.get("labels") or []]
    merged, middle = merged_labels(labels), median_apart(labels)
    if middle is not None:
        n_apart = count(len(labels) - len(merged), "labelled object")
        but = f"; {len(merged)} more are merged with others" if merged else ""
        rows.append((f"{middle:.2f}", f"median mask IoU of {n_apart}{' that stand apart' if merged else ''}{but}"))
    n_matches = [
        c.metadata.n_matches for name in chosen.scenes if (c := _readable(find(dataset, Correspondences, name)))
    ]
    if n_matches:
        rows.append((f"{sum(n_matches):,}", "matches between views"))
    for variant, figures in chosen.measured.descriptors().get("variants", {}).items():
        pck = figures["all"]["pck_4"]
        if pck is not None:
            rows.append((percent(pck), f"of true matches found within 4 % of the image's diagonal by {variant}"))
    for name, variant, scored in chosen.tracks:
        if variant != chosen.tracks[0][1]:  # Other variants are compared in their own section.
            continue
        try:
            figures = figures_of_track(scored)
        except UNREADABLE:  # Its own section reports it.
            continue
        where = name if variant == "main" else f"{name} ({variant})"
        rows.append((str(figures["n_keypoints"]), f"keypoints tracked over {figures['n_frames']} frames of {where}"))
        if figures["error_m"].n:
            rows.append((millimetres(figures["error_m"].median), f"median keypoint error in {where}"))
        if figures["on_object"].n:
            rows.append(
                (percent(figures["on_object"].right), f"of keypoint positions on the correct object in {where}")
            )
    return rows


def _readable(artifact: A | None) -> A | None:
    """The artifact if its metadata can be read; its own section reports it otherwise."""
    if artifact is None:
        return None
    try:
        _ = artifact.metadata
    except UNREADABLE:
        return None
    return artifact


def _cameras(dataset: Dataset, name: str) -> list[Any]:
    recording = find_recording(dataset, name)
    return recording.cameras if recording else []
