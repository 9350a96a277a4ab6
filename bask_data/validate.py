"""Validation: files are checked against their SHA-256, arrays and tables against their schema."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bask_data.artifact import (
    MANIFEST,
    REMAKE,
    Artifact,
    FileEntry,
    content_digest,
    file_digest,
    list_files,
    read_json,
    read_manifest,
)
from bask_data.dataset import Dataset
from bask_data.errors import BaskError
from bask_data.kinds import KINDS
from bask_data.kinds.arrays import spec_of
from bask_data.progress import progress


@dataclass(frozen=True)
class Problem:
    """A problem of a dataset; `fix` is a command or an action."""

    where: str
    what: str
    fix: str

    def __str__(self) -> str:
        return f"{self.where}: {self.what}  fix: {self.fix}"


def artifacts_on_disk(dataset: Dataset) -> list[Artifact]:
    """Every artifact that is listed in the dataset and exists, in the order of the kinds."""
    artifacts: list[Artifact] = []
    for kind in KINDS:
        items = dataset.items(kind.scope) if kind.scope != "dataset" else [""]
        for variant in dataset.variants(kind):
            paths = [dataset.path(kind, item, variant) for item in items]
            artifacts += [kind(path) for path in paths if path.exists()]
    return artifacts


def validate(dataset: Dataset) -> list[Problem]:
    """All problems of a dataset; empty if it is valid."""
    problems = list(_missing_recordings(dataset))
    for artifact in progress(artifacts_on_disk(dataset), "validating"):
        try:
            problems += _files(artifact, dataset.root)
            problems += _schema(artifact, dataset.root)
        except BaskError as error:
            problems.append(Problem(_relative(artifact.path, dataset.root), error.fault, error.fix or REMAKE))
    problems += _unlisted(dataset)
    return problems


def _missing_recordings(dataset: Dataset) -> Iterator[Problem]:
    for scope, kind in (("scene", "scan"), ("demonstration", "demonstration")):
        for item in dataset.items(scope):
            if not (dataset.root / kind / item).exists():
                yield Problem(
                    f"{kind}/{item}", "listed in dataset.json, but missing.", "ingest it again, or `dvc pull`."
                )


def _files(artifact: Artifact, root: Path) -> Iterator[Problem]:
    """Files that are missing, changed, or not in the manifest."""
    manifest = read_manifest(artifact.path)
    where = _relative(artifact.path, root)
    present = dict(list_files(artifact.path))
    for name in sorted(manifest.files.keys() - present.keys()):
        yield Problem(f"{where}/{name}", "missing.", REMAKE)
    for name in sorted(present.keys() - manifest.files.keys()):
        yield Problem(f"{where}/{name}", "not part of the artifact.", "move it elsewhere.")
    for name in sorted(present.keys() & manifest.files.keys()):
        digest = file_digest(present[name])
        if digest != manifest.files[name].sha256:
            yield Problem(
                f"{where}/{name}",
                f"expected SHA-256 {manifest.files[name].sha256[:12]}..., got {digest[:12]}....",
                REMAKE,
            )
    if content_digest(manifest.files) != manifest.digest:
        yield Problem(f"{where}/{MANIFEST}", "digest: does not match the list of files.", REMAKE)
    if not artifact.can_open(manifest):
        got = f"{manifest.kind} v{manifest.schema_version}"
        expected = f"{artifact.kind} v{artifact.schema_version}"
        yield Problem(f"{where}/{MANIFEST}", f"kind: expected {expected}, got {got}.", REMAKE)


def _schema(artifact: Artifact, root: Path) -> Iterator[Problem]:
    """Arrays and tables that do not match the kind's schema."""
    where = _relative(artifact.path, root)
    artifact.metadata  # noqa: B018  # Reading it checks it.
    sizes: dict[tuple[str, str], tuple[int, str]] = {}
    seen = set()
    for name, document in _array_documents(artifact.path):
        try:
            spec = spec_of(type(artifact), name)
        except KeyError:
            yield Problem(f"{where}/{name}", "not an array of the schema.", REMAKE)
            continue
        seen.add(name)
        shape, dtype = document.get("shape", []), document.get("data_type")
        if dtype != spec.dtype:
            yield Problem(f"{where}/{name}", f"data_type: expected {spec.dtype}, got {dtype}.", REMAKE)
        dims = spec.dims_of(len(shape))
        if dims is None:
            expected_dims = " or ".join(f"({', '.join(axes)})" for axes in (spec.dims, spec.other_dims) if axes)
            yield Problem(f"{where}/{name}", f"shape: expected {expected_dims}, got {shape}.", REMAKE)
            continue
        camera = name.split("/")[0] if "{camera}/" + name.split("/", 1)[-1] in artifact.arrays else ""
        for dim, length in zip(dims, shape, strict=True):
            if dim.isdigit():
                expected, reason = int(dim), ""
            else:
                expected, like = sizes.setdefault((camera if dim in "thw" else "", dim), (length, name))
                reason = f"{dim} = {expected} as {like}"
            if length != expected:
                yield Problem(f"{where}/{name}", f"shape: expected {reason or expected}, got {length}.", REMAKE)
        missing = [key for key in spec.attributes if key not in document.get("attributes", {})]
        if missing:
            yield Problem(f"{where}/{name}", f"attributes: expected {', '.join(missing)}.", REMAKE)
    for pattern, spec in artifact.arrays.items():
        if "{camera}" not in pattern:
            names = [pattern]
        else:
            names = [pattern.replace("{camera}", camera) for camera in artifact.camera_names]
        for name in names:
            if name not in seen and not spec.optional:
                yield Problem(f"{where}/{name}", "missing: required by the schema.", REMAKE)
    for name in artifact.tables:
        yield from _table(artifact, name, where)
    for name in artifact.files:
        if not (artifact.path / name).exists():
            yield Problem(f"{where}/{name}", "missing: required by the schema.", REMAKE)


def _table(artifact: Artifact, name: str, where: str) -> Iterator[Problem]:
    import pyarrow as pa
    import pyarrow.parquet as pq

    from bask_data.kinds.tables import arrow_schema

    try:
        schema = pq.read_schema(artifact.path / name)
    except (OSError, pa.ArrowException) as error:
        yield Problem(f"{where}/{name}", f"expected a Parquet table, got {error}.", REMAKE)
        return
    expected = arrow_schema(artifact.tables[name])
    if not schema.equals(expected):
        yield Problem(f"{where}/{name}", f"columns: expected {expected.names}, got {schema.names}.", REMAKE)


def _array_documents(path: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    for name, file in list_files(path):
        if file.name == "zarr.json":
            document = read_json(file)
            if isinstance(document, dict) and document.get("node_type") == "array":
                yield name.removesuffix("/zarr.json"), document


def _unlisted(dataset: Dataset) -> Iterator[Problem]:
    """Directories that `dataset.json` does not list, which `status` and `run` would ignore."""
    for kind in KINDS:
        if kind.scope == "dataset":
            continue
        listed = set(dataset.items(kind.scope))
        folders = (
            [dataset.root / kind.kind / variant for variant in dataset.variants(kind)]
            if kind.has_variants
            else [dataset.root / kind.kind]
        )
        for folder in folders:
            if not folder.is_dir():
                continue
            for entry in sorted(folder.iterdir()):
                if entry.is_dir() and entry.name not in listed:
                    yield Problem(
                        _relative(entry, dataset.root), "not listed in dataset.json.", "remove it, or ingest it."
                    )


def _relative(path: Path, root: Path) -> str:
    return path.relative_to(root).as_posix()


def total_bytes(files: dict[str, FileEntry]) -> int:
    """Total size of an artifact's files, bytes."""
    return sum(entry.bytes for entry in files.values())
