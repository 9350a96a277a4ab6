"""The artifacts of a dataset, with the stage that made each, its size and its cost."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from bask_data.artifact import Artifact, read_json
from bask_data.dataset import Dataset
from bask_data.errors import BadData
from bask_data.evaluation.lookup import find
from bask_data.kinds import KINDS


@dataclass(frozen=True)
class MadeArtifact:
    """An artifact that exists; `seconds` and `peak_bytes` are None without a record of them."""

    artifact: str
    made_by: str
    bytes: int
    digest: str
    seconds: float | None
    peak_bytes: int | None
    time: str


def made(dataset: Dataset) -> list[MadeArtifact]:
    """Every artifact of the dataset that exists, in the order of the stages."""
    artifacts = []
    for kind in KINDS:
        items = [""] if kind.scope == "dataset" else dataset.items(kind.scope)
        for variant in dataset.variants(kind):
            for item in items:
                artifact = find(dataset, kind, item, variant)
                if artifact is not None:
                    artifacts.append(_made(dataset, artifact))
    return artifacts


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
    # A record of an earlier version of the artifact does not apply.
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
