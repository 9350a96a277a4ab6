"""Artifacts of a dataset that are damaged, of an older version or out of date, and files that belong to none."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

from bask_data.artifact import MANIFEST, SCRATCH, Artifact, Manifest, list_files
from bask_data.dataset import DATASET, Dataset
from bask_data.engine import PARAMS
from bask_data.errors import BadData
from bask_data.evaluation.lookup import UNREADABLE, what_is_wrong
from bask_data.findings import Finding
from bask_data.kinds import KINDS, Recording
from bask_data.validate import artifacts_on_disk

PROVENANCE = "provenance"
"""Folder of records of who made an artifact and when; outside artifacts, so that their digests do not depend on it."""

BESIDE = {
    DATASET,
    "zarr.json",
    PARAMS,
    SCRATCH,
    PROVENANCE,
    "dvc.yaml",
    "dvc.lock",
    "README.md",
    "LICENSE",
    "metrics",
    "evaluation",
}
"""What belongs into a dataset's folder besides artifacts; hidden files, too."""

PAGES = {".html", ".md", ".txt", ".png", ".jpg", ".rrd", ".mp4", ".json", ".yaml", ".yml"}
"""Endings of files in a dataset's folder that people put there: reports, notes, picks. They harm nothing."""


def artifact_findings(dataset: Dataset) -> list[Finding]:
    """What is wrong with files, versions and manifests, without reading arrays: `validate` compares every byte."""
    findings = list(_missing(dataset))
    digests: dict[str, str] = {}
    made: list[tuple[str, Manifest]] = []
    for artifact in artifacts_on_disk(dataset):
        place = artifact.path.relative_to(dataset.root).as_posix()
        try:
            manifest = artifact.manifest
        except BadData as error:
            findings.append(damaged(dataset, place, error.fault))
            continue
        digests[place] = manifest.digest
        made.append((place, manifest))
        findings += _of_artifact(dataset, artifact, place, manifest)
    findings += _stale(dataset, made, digests)
    return [*findings, *_unlisted(dataset)]


def unless_damaged(
    dataset: Dataset, place: str, artifacts: Sequence[Artifact], check: Callable[[], Iterable[Finding]]
) -> list[Finding]:
    """The findings of a check that reads artifacts; none if files of these are missing, which is found elsewhere."""
    try:
        for artifact in artifacts:
            artifact.check_complete()
    except BadData:
        return []
    try:
        return list(check())
    except UNREADABLE as error:
        return [damaged(dataset, place, what_is_wrong(error))]


def damaged(dataset: Dataset, place: str, evidence: str) -> Finding:
    """The finding of something that cannot be read."""
    fix = f"bask-data validate {shlex.quote(str(dataset.root))} lists all damage and its fixes"
    return Finding("damaged", place, evidence, fix)


def _missing(dataset: Dataset) -> Iterator[Finding]:
    for scope, kind in (("scene", "scan"), ("demonstration", "demonstration")):
        for item in dataset.items(scope):
            if not (dataset.root / kind / item).exists():
                yield damaged(dataset, f"{kind}/{item}", f"listed in {DATASET}, but there is no such folder")


def _of_artifact(dataset: Dataset, artifact: Artifact, place: str, manifest: Manifest) -> Iterator[Finding]:
    """Files that are missing, of another size or too many; another version."""
    present = dict(list_files(artifact.path))
    missing = sorted(manifest.files.keys() - present.keys())
    other = sorted(
        name
        for name in present.keys() & manifest.files.keys()
        if present[name].stat().st_size != manifest.files[name].bytes
    )
    extra = sorted(present.keys() - manifest.files.keys())
    if missing:
        yield damaged(dataset, place, f"{len(missing)} of {len(manifest.files)} files are missing, as {missing[0]}")
    if other:
        yield damaged(dataset, place, f"{len(other)} files are of another size than recorded, as {other[0]}")
    if extra:
        evidence = f"{len(extra)} files are in no manifest, as {extra[0]}"
        yield Finding("unlisted-file", place, evidence, "move them elsewhere: nobody knows what made them")
    if manifest.kind == artifact.kind and manifest.schema_version < artifact.schema_version:
        versions = f"{artifact.kind} v{manifest.schema_version}; this version writes v{artifact.schema_version}"
        is_opened = artifact.can_open(manifest)
        fix = _remake(dataset, artifact)
        if is_opened:
            yield Finding("version-old", place, f"{versions} and opens both", f"nothing, or to have the newer: {fix}")
        else:
            yield Finding("version-unreadable", place, f"{versions} and opens no other", fix)
    elif not artifact.can_open(manifest):
        expected = f"{artifact.kind} v{artifact.schema_version}"
        got = f"{manifest.kind} v{manifest.schema_version}"
        yield damaged(dataset, place, f"expected {expected}, got {got}: made by a newer version, or moved there")


def _remake(dataset: Dataset, artifact: Artifact) -> str:
    root = shlex.quote(str(dataset.root))
    return "ingest it again with --force" if isinstance(artifact, Recording) else f"bask-data run {root}"


def _stale(dataset: Dataset, made: list[tuple[str, Manifest]], digests: dict[str, str]) -> Iterator[Finding]:
    """Artifacts whose inputs have other content than when they were made."""
    for place, manifest in made:
        changed = [name for name, digest in manifest.inputs.items() if digests.get(name, digest) != digest]
        if changed:
            evidence = f"made from another {', '.join(changed[:3])}{' and more' if changed[3:] else ''} than is there"
            yield Finding("stale", place, evidence, f"bask-data run {shlex.quote(str(dataset.root))}")


def _unlisted(dataset: Dataset) -> Iterator[Finding]:
    """Folders and files of a dataset that no manifest and no list names."""
    kinds = {kind.kind: kind for kind in KINDS}
    for entry in sorted(dataset.root.iterdir()):
        name = entry.name
        if name.startswith(".") or name in BESIDE or name in kinds or name.endswith(".dvc"):
            continue
        if _is_harmless(entry):
            continue
        yield Finding("unlisted-file", name, "in the dataset's folder, but part of no artifact", "move it elsewhere")
    for kind in kinds.values():
        yield from _unlisted_of(dataset, kind)


def _unlisted_of(dataset: Dataset, kind: type[Artifact]) -> Iterator[Finding]:
    """Entries of a kind's folder that are no artifact of the dataset."""
    folder = dataset.root / kind.kind
    if not folder.is_dir():
        return
    variants = set(dataset.variants(kind))
    items = set(dataset.items(kind.scope)) if kind.scope != "dataset" else set()
    levels = [(folder, variants if kind.has_variants else items)]
    if kind.has_variants and kind.scope != "dataset":
        levels += [(folder / variant, items) for variant in variants if (folder / variant).is_dir()]
    if kind.scope == "dataset" and not kind.has_variants:
        return
    for within, listed in levels:
        for entry in sorted(within.iterdir()):
            if entry.name in listed or entry.name.startswith(".") or entry.name in ("zarr.json", MANIFEST):
                continue
            if entry.suffix == ".dvc" or entry.name == "metrics":
                continue
            place = entry.relative_to(dataset.root).as_posix()
            evidence = f"not listed in {DATASET}: `run` and `status` do not know it"
            yield Finding("unlisted-file", place, evidence, "remove it, or ingest it under that name again")


def _is_harmless(entry: Path) -> bool:
    """Whether a file is what people put beside data, documents and pictures; or a folder holds nothing else."""
    files = [entry] if entry.is_file() else [file for file in entry.rglob("*") if file.is_file()]
    return all(file.suffix.lower() in PAGES and file.name not in ("zarr.json", MANIFEST) for file in files)
