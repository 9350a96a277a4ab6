"""What only shows when recordings and artifacts of a dataset are looked at together."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from bask_data.artifact import Artifact
from bask_data.dataset import Dataset, Splits
from bask_data.doctor.artifact_checks import artifact_findings
from bask_data.doctor.demonstration_checks import demonstration_findings
from bask_data.doctor.identity_checks import identity_findings
from bask_data.doctor.scene_checks import scene_findings
from bask_data.doctor.twins import twin_findings
from bask_data.evaluation.lookup import find
from bask_data.findings import Finding
from bask_data.kinds import Identities, KeypointTrack, ObjectInstances
from bask_data.progress import progress
from bask_data.spelling import number_of


def dataset_findings(dataset: Dataset, names: Sequence[str]) -> tuple[list[Finding], list[str]]:
    """Findings of the dataset, and what was found right, in sentences.

    Args:
        names: recordings whose objects, masks, motion and keypoints are checked. Files, and recordings that show the
            same, are looked for in the whole dataset.
    """
    scenes = [name for name in names if name in dataset.file.scenes]
    demonstrations = [name for name in names if name in dataset.file.demonstrations]
    n_objects = _number(dataset, ObjectInstances, scenes)
    n_tracks = _number(dataset, KeypointTrack, demonstrations)
    recordings = number_of(len(dataset.items("recording")), "recording")
    checks: list[tuple[str, Callable[[], list[Finding]]]] = [
        ("files, versions and inputs of all artifacts", lambda: artifact_findings(dataset)),
        (f"no two of {recordings} show the same", lambda: twin_findings(dataset)),
        (f"objects and masks of {number_of(n_objects, 'scan')}", lambda: scene_findings(dataset, scenes)),
        (
            f"motion of {number_of(len(demonstrations), 'demonstration')}, and keypoints of {n_tracks}",
            lambda: demonstration_findings(dataset, demonstrations),
        ),
        ("every object has a partner in another scan", lambda: identity_findings(dataset)),
    ]
    is_compared = len(dataset.items("recording")) > 1 or dataset.file.splits != Splits()
    is_checked = [True, is_compared, n_objects > 0, bool(demonstrations), find(dataset, Identities) is not None]
    findings: list[Finding] = []
    right: list[str] = []
    chosen = [check for check, wanted in zip(checks, is_checked, strict=True) if wanted]
    for sentence, check in progress(chosen, "comparing recordings and artifacts", len(chosen)):
        found = check()
        findings += found
        if not found:
            right.append(sentence)
    return findings, right


def _number(dataset: Dataset, kind: type[Artifact], names: Sequence[str]) -> int:
    return sum(dataset.path(kind, name).exists() for name in names)
