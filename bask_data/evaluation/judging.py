"""The table of verdicts of a dataset: its artifacts read and judged, stage by stage."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np

from bask_data.artifact import Artifact
from bask_data.core.track_scores import step_length
from bask_data.dataset import Dataset
from bask_data.evaluation import keypoint_verdicts as of_keypoints
from bask_data.evaluation import recording_verdicts as of_recording
from bask_data.evaluation import scene_verdicts as of_scene
from bask_data.evaluation.figures import Measured
from bask_data.evaluation.ingest_again import ingest_command
from bask_data.evaluation.label_matches import labels_confirm
from bask_data.evaluation.lookup import UNREADABLE, find, find_truth, what_is_wrong
from bask_data.evaluation.track_figures import figures_of_track
from bask_data.evaluation.usual import JUMP_M
from bask_data.evaluation.verdicts import ItemVerdict, StageVerdict, after_failures, not_made, stage_verdict
from bask_data.findings import Finding
from bask_data.kinds import (
    Correspondences,
    Demonstration,
    DescriptorNet,
    Identities,
    KeypointTrack,
    ObjectInstances,
    Reconstruction,
    Recording,
    ReferenceKeypoints,
    Scan,
    VisibleMasks,
)
from bask_data.spelling import number_of

MOST_LABELLED = 3
"""Scenes whose masks are compared with labels for the verdict, as every frame has to be read."""

A = TypeVar("A", bound=Artifact)


def verdicts(dataset: Dataset, measured: Measured) -> list[StageVerdict]:
    """A row for each stage, in the order of the stages; none for a dataset without recordings."""
    if not dataset.items("recording"):
        return []
    rows = [
        *_of_recordings(dataset, Scan, "Scans", ""),
        *_of_scenes(dataset, measured),
        *_of_identities(dataset),
        *_of_networks(dataset, measured),
        *_of_recordings(dataset, Demonstration, "Demonstrations", " --as demonstration"),
        *_of_keypoints(dataset, measured),
    ]
    root = shlex.quote(str(dataset.root))
    return [
        replace(
            row,
            fix=row.fix.replace("ROOT", root),
            findings=tuple(replace(each, fix=each.fix.replace("ROOT", root)) for each in row.findings),
        )
        for row in after_failures(rows)
    ]


def _of_recordings(dataset: Dataset, kind: type[Recording], stage: str, options: str) -> list[StageVerdict]:
    is_scan = kind is Scan

    def judge(name: str, recording: Recording) -> ItemVerdict:
        def again(fix: str) -> str:
            return ingest_command(dataset, name, fix)

        return of_recording.recording_judgement(name, recording.metadata, again, is_scan=is_scan)

    names = dataset.items("scene" if is_scan else "demonstration")
    fix = f"bask-data ingest auto SOURCE ROOT{options}"
    if not names:
        why = "no scan to learn from" if is_scan else "none, so there is nothing to track keypoints in"
        return [not_made(stage, why, fix)]
    return [_judged(dataset, kind, stage, names, judge, fix)]


def _of_scenes(dataset: Dataset, measured: Measured) -> list[StageVerdict]:
    scenes = dataset.items("scene")
    if not scenes:
        return []
    compared = [name for name in scenes if find_truth(dataset, name)][:MOST_LABELLED]

    def labels(name: str) -> list[dict[str, Any]]:
        return (measured.masks(name).get("labels") or []) if name in compared else []

    def n_unmeasured(name: str) -> int:
        mesh = find(dataset, Reconstruction, name)
        return len(mesh.metadata.unmeasured) if mesh else 0

    return [
        _judged(
            dataset,
            Reconstruction,
            "Surface",
            scenes,
            lambda name, made: of_scene.reconstruction_judgement(name, made.metadata),
            "bask-data run ROOT",
        ),
        _judged(
            dataset,
            ObjectInstances,
            "Objects",
            scenes,
            lambda name, made: of_scene.without_depth(
                of_scene.objects_judgement(
                    name, made.metadata, made.findings(), is_confirmed=labels_confirm(labels(name))
                ),
                n_unmeasured(name),
            ),
            "bask-data run ROOT",
        ),
        _judged(
            dataset,
            VisibleMasks,
            "Visible masks",
            scenes,
            lambda name, made: of_scene.without_depth(
                of_scene.masks_judgement(name, made.metadata, labels(name)), n_unmeasured(name)
            ),
            "bask-data run ROOT",
        ),
        _judged(
            dataset,
            Correspondences,
            "Matches",
            scenes,
            lambda name, made: of_scene.correspondences_judgement(name, made.metadata),
            "bask-data run ROOT",
        ),
    ]


def _of_identities(dataset: Dataset) -> list[StageVerdict]:
    """The row of `identify`, which is made on request: none if it has not been."""
    name = _variant(dataset, Identities)

    def judge(variant: str, made: Identities) -> ItemVerdict:
        n_objects = len(made.of_instances()) + len(made.metadata.unknown)
        objects = number_of(n_objects, "object")
        evidence = f"{n_objects - len(made.metadata.unknown)} of {objects} recognised in another scan"
        return ItemVerdict(variant, evidence, findings=tuple(made.findings()))

    return [_judged(dataset, Identities, "Identities", [name], judge, "bask-data identify ROOT")] if name else []


def _of_networks(dataset: Dataset, measured: Measured) -> list[StageVerdict]:
    name = _variant(dataset, DescriptorNet)
    if not name:
        return [not_made("Training", "no descriptor network", "bask-data run ROOT")] if dataset.items("scene") else []

    def judge(variant: str, network: DescriptorNet) -> ItemVerdict:
        known = network.metadata
        return of_keypoints.network_judgement(variant, known.metrics, known.validated_on, known.step)

    rows = [_judged(dataset, DescriptorNet, "Training", [name], judge, "bask-data run ROOT")]
    result = measured.descriptors()
    if figures := result.get("variants", {}).get(name):
        row = of_keypoints.evaluation_judgement(name, figures["all"]["pck_4"], str(result["measured_on"]))
        rows.append(stage_verdict("Evaluation", [row], [], ""))
    return rows


def _of_keypoints(dataset: Dataset, measured: Measured) -> list[StageVerdict]:
    demonstrations = dataset.items("demonstration")
    if not demonstrations and not _variant(dataset, ReferenceKeypoints):
        return []

    def judge_reference(variant: str, reference: ReferenceKeypoints) -> ItemVerdict:
        return of_keypoints.reference_judgement(variant, reference.picks)

    stage, name = "Reference keypoints", _variant(dataset, ReferenceKeypoints)
    rows = [not_made(stage, "no keypoints picked", "bask-data reference ROOT --pick")]
    if name:
        rows = [_judged(dataset, ReferenceKeypoints, stage, [name], judge_reference, "bask-data reference ROOT")]
    if not demonstrations:
        return rows
    variant = _variant(dataset, KeypointTrack) or "main"

    def judge_track(item: str, track: KeypointTrack) -> ItemVerdict:
        steps = step_length(track.mean)
        known = np.isfinite(steps)
        jumps = float((steps[known] > JUMP_M).mean()) if known.any() else float("nan")
        return of_keypoints.track_judgement(item, figures_of_track(measured.track(item, variant)), jumps)

    fix = "bask-data run ROOT"
    return [*rows, _judged(dataset, KeypointTrack, "Tracked keypoints", demonstrations, judge_track, fix, variant)]


def _variant(dataset: Dataset, kind: type[Artifact]) -> str:
    """The variant that is judged: `main`, or else the first that was made; others are there to be compared with it."""
    made = [name for name in dataset.variants(kind) if _exists(dataset, kind, name)]
    return "main" if "main" in made else made[0] if made else ""


def _exists(dataset: Dataset, kind: type[Artifact], variant: str) -> bool:
    items = [""] if kind.scope == "dataset" else dataset.items(kind.scope)
    return any(find(dataset, kind, item, variant) for item in items)


def _judged(
    dataset: Dataset,
    kind: type[A],
    stage: str,
    names: Sequence[str],
    judge: Callable[[str, A], ItemVerdict],
    fix: str,
    variant: str = "main",
) -> StageVerdict:
    """The row of a stage; what cannot be read fails."""
    found, missing = [], []
    for name in names:
        is_shared = kind.scope == "dataset"
        artifact = find(dataset, kind, "" if is_shared else name, name if is_shared else variant)
        if artifact is None:
            missing.append(name)
            continue
        try:
            found.append(judge(name, artifact))
        except UNREADABLE as error:
            why = Finding("unreadable", name, what_is_wrong(error), f"{fix} --force")
            found.append(ItemVerdict(name, "cannot be read", findings=(why,)))
    return stage_verdict(stage, found, missing, fix)
