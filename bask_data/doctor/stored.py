"""A dataset examined: every camera of its recordings, and what shows when recordings and artifacts are compared."""

from __future__ import annotations

import shlex
from collections.abc import Sequence

from bask_data.dataset import Dataset
from bask_data.doctor.dataset_checks import dataset_findings
from bask_data.doctor.examination import Examination, ExaminedCamera
from bask_data.doctor.recording import Settings, examine_camera, of_stored
from bask_data.doctor.recording_checks import stamp_findings
from bask_data.errors import BadData
from bask_data.evaluation.ingest_again import ingest_command
from bask_data.findings import Finding
from bask_data.kinds import Demonstration, Recording, Scan
from bask_data.progress import progress


def examine_dataset(dataset: Dataset, only: Sequence[str] = (), with_pictures: bool = False) -> Examination:
    """All checks of a dataset's recordings and artifacts.

    Args:
        only: recordings whose images are examined; all of them by default. The dataset's own checks are about these,
            too, but for those that compare recordings.

    Raises:
        UsageError: no recording has one of these names, or the dataset has none.
    """
    names = dataset.select(only)
    findings: list[Finding] = []
    cameras: list[ExaminedCamera] = []
    for name in progress(names, "examining recordings", len(names)):
        try:
            of_recording, stamps = _examined(dataset, name, with_pictures)
        except BadData as error:
            fix = f"bask-data validate {shlex.quote(str(dataset.root))}"
            of_recording, stamps = [], [Finding("damaged", name, error.fault, fix)]
        cameras += of_recording
        findings += stamps
    of_dataset, right = dataset_findings(dataset, names)
    return Examination(str(dataset.root), tuple(cameras), (*findings, *of_dataset), tuple(right))


def _examined(dataset: Dataset, name: str, with_pictures: bool) -> tuple[list[ExaminedCamera], list[Finding]]:
    """The cameras of a recording, and what is wrong between them."""
    kind = Scan if name in dataset.file.scenes else Demonstration
    path = dataset.path(kind, name)
    if not path.exists():
        return [], []  # The dataset's own checks report it.
    recording: Recording = kind(path)
    recording.check_complete()
    settings = Settings(with_pictures, ingest_command(dataset, name), recording.metadata.assumptions)
    cameras = recording.cameras
    examined = [examine_camera(f"{name}/{each.name}", of_stored(each), settings) for each in cameras]
    return examined, stamp_findings(name, {each.name: each.time for each in cameras})
