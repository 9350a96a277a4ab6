"""Artifacts: typed, immutable directories that are published as a whole or not at all.

An artifact is a Zarr v3 group with a manifest, `artifact.json`, which states what made it and the SHA-256 of every
other file. The manifest is deterministic: it contains no time, host or user, so equal inputs give equal bytes.
"""

from __future__ import annotations

import ctypes
import errno
import hashlib
import json
import os
import shutil
import socket
import uuid
from collections.abc import Iterator
from contextlib import suppress
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from pydantic import BaseModel, ConfigDict, ValidationError

from bask_data.errors import BadData
from bask_data.params import first_fault
from bask_data.specs import ArraySpec, TableSpec

if TYPE_CHECKING:
    import zarr

MANIFEST = "artifact.json"
SCRATCH = ".scratch"
REMAKE = "make it again with --force, a recording with `bask-data ingest`."
"""The fix for an artifact with invalid content."""
RESTORE = "correct the file, or restore it from a copy."
"""The fix for a file with invalid content that cannot be made again."""
MOST_JSON_BYTES = 64 * 2**20
"""Largest JSON document that is read, in bytes; ours are far smaller."""
_AT_FDCWD, _RENAME_EXCHANGE = -100, 2

Scope = Literal["scene", "demonstration", "recording", "dataset"]
"""What an artifact belongs to. A `recording` is a scene or a demonstration."""


class Metadata(BaseModel):
    """Base of a kind's metadata: the attribute `bask` of its group, without `kind` and `schema`."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class FileEntry(BaseModel):
    """One file of an artifact, as its manifest records it."""

    sha256: str
    bytes: int


class Manifest(BaseModel):
    """The content of `artifact.json`.

    Args:
        key: SHA-256 over everything the result depends on; same key on disk means up to date.
        inputs: content digest by path relative to the dataset, or by a name for what is no artifact.
        digest: SHA-256 over `files`, the content digest that later stages see.
    """

    model_config = ConfigDict(extra="forbid")

    kind: str
    schema_version: int
    stage: str
    stage_version: int
    params: dict[str, Any]
    inputs: dict[str, str]
    key: str
    files: dict[str, FileEntry]
    digest: str


class Artifact:
    """A handle on a published artifact. Subclasses, one per kind, declare its contents and read them."""

    kind: ClassVar[str]
    scope: ClassVar[Scope]
    has_variants: ClassVar[bool] = False
    schema_version: ClassVar[int] = 1
    opens: ClassVar[tuple[int, ...]] = ()
    """Older versions of the schema that are opened, too."""
    metadata_model: ClassVar[type[Metadata]] = Metadata
    arrays: ClassVar[dict[str, ArraySpec]] = {}
    tables: ClassVar[dict[str, TableSpec]] = {}
    files: ClassVar[dict[str, str]] = {}

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({str(self.path)!r})"

    @cached_property
    def manifest(self) -> Manifest:
        """The manifest; `BadData` if it is missing or damaged."""
        return read_manifest(self.path)

    @cached_property
    def group(self) -> zarr.Group:
        """The Zarr group, read-only."""
        import zarr

        try:
            return zarr.open_group(str(self.path), mode="r", zarr_format=3)
        except Exception as error:
            raise BadData(self.path, "zarr.json", expected="a Zarr v3 group", got=str(error), fix=REMAKE) from error

    @cached_property
    def attributes(self) -> dict[str, Any]:
        """The `bask` attribute of the group as a plain dictionary."""
        return read_attributes(self.path).get("bask", {})

    @cached_property
    def metadata(self) -> Any:
        """The kind's metadata, checked against its model."""
        fields = {name: value for name, value in self.attributes.items() if name not in ("kind", "schema")}
        try:
            return self.metadata_model.model_validate(fields)
        except ValidationError as error:
            field, expected, came = first_fault(error)
            raise BadData(self.path / "zarr.json", f"bask.{field}", expected=expected, got=came, fix=REMAKE) from error

    def summary(self) -> list[str]:
        """Lines to show when the artifact was made; most kinds have none."""
        return []

    @classmethod
    def can_open(cls, manifest: Manifest) -> bool:
        """Whether an artifact with this manifest is of this kind, and of a version that is opened."""
        return manifest.kind == cls.kind and manifest.schema_version in (cls.schema_version, *cls.opens)

    def check_complete(self) -> None:
        """Refuse an artifact of another version, or with missing files: a missing chunk would read as zeros.

        Raises:
            BadData: the manifest is damaged, of another kind or version, or lists a file that is missing.
        """
        manifest = self.manifest
        if not self.can_open(manifest):
            expected, got = f"{self.kind} v{self.schema_version}", f"{manifest.kind} v{manifest.schema_version}"
            raise BadData(self.path, "schema", expected=expected, got=got, fix="make it again: `bask-data run`.")
        for name in manifest.files:
            if not (self.path / name).exists():
                raise BadData(
                    self.path, name, expected="the file", got="none", fix="restore it, or make the artifact again."
                )

    @property
    def camera_names(self) -> list[str]:
        """Names of the cameras, sorted; empty for kinds without cameras."""
        names = (folder.name for folder in self.path.iterdir() if (folder / "zarr.json").exists())
        return sorted(
            name
            for name in names
            if read_json(self.path / name / "zarr.json").get("node_type") == "group"
            and name not in ("robot", "objects")
        )


def canonical_json(value: object) -> bytes:
    """JSON with sorted keys and no spaces: equal values give equal bytes. `ValueError` for NaN and infinity."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False).encode()


def digest_of(value: object) -> str:
    """SHA-256 of a JSON value, in hexadecimal."""
    return hashlib.sha256(canonical_json(value)).hexdigest()


def file_digest(path: Path) -> str:
    """SHA-256 of a file's bytes, in hexadecimal."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def read_attributes(group: Path) -> dict[str, Any]:
    """The attributes of a Zarr v3 group, without the cost of importing zarr; `BadData` if it is not one."""
    file = group / "zarr.json"
    document = read_json(file, REMAKE)
    if not isinstance(document, dict) or document.get("node_type") != "group" or document.get("zarr_format") != 3:
        raise BadData(file, "node_type", expected="a Zarr v3 group", got=str(document)[:60], fix=REMAKE)
    attributes = document.get("attributes", {})
    return attributes if isinstance(attributes, dict) else {}


def write_group(path: Path, attributes: dict[str, Any]) -> None:
    """Make a directory a Zarr v3 group with these attributes."""
    path.mkdir(parents=True, exist_ok=True)
    document = {"zarr_format": 3, "node_type": "group", "attributes": attributes}
    (path / "zarr.json").write_text(json.dumps(document, indent=2, ensure_ascii=False, allow_nan=False) + "\n")


def read_json(file: Path, fix: str = RESTORE) -> Any:
    """A JSON document; `BadData` with the path if it is missing, too large or invalid.

    Args:
        fix: what to do about an invalid document, for the error.
    """
    try:
        size = file.stat().st_size
        if size > MOST_JSON_BYTES:
            raise BadData(file, "", expected="a JSON document below 64 MiB", got=f"{size} bytes", fix=fix)
        return json.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise BadData(file, "", expected="a file", got="nothing", fix=fix) from None
    except (ValueError, RecursionError, OSError) as error:
        raise BadData(file, "", expected="a JSON document", got=_json_fault(error), fix=fix) from error


def _json_fault(error: Exception) -> str:
    """What is wrong with a JSON file, in plain words: Python's messages are about its parser."""
    if isinstance(error, json.JSONDecodeError):
        return f"a syntax error in line {error.lineno}, column {error.colno}" if error.doc.strip() else "an empty file"
    words = {UnicodeDecodeError: "bytes that are not UTF-8 text", RecursionError: "values nested too deeply"}
    other = f"a file that cannot be read ({error.strerror})" if isinstance(error, OSError) else "too many digits"
    return "a directory" if isinstance(error, IsADirectoryError) else words.get(type(error), other)


def write_json_atomically(file: Path, value: object) -> None:
    """Replace a JSON file atomically: readers see the old one or the new one."""
    write_text_atomically(file, json.dumps(value, indent=2, ensure_ascii=False, allow_nan=False) + "\n")


def write_text_atomically(file: Path, text: str) -> None:
    """Replace a text file atomically: readers see the old one or the new one. A failure leaves no temporary file."""
    file.parent.mkdir(parents=True, exist_ok=True)
    temporary = file.with_name(f".{file.name}.{os.getpid()}.{uuid.uuid4().hex[:8]}")
    try:
        temporary.write_text(text, encoding="utf-8")
        _sync(temporary)
        os.replace(temporary, file)
    finally:
        temporary.unlink(missing_ok=True)
    _sync(file.parent)


def read_manifest(path: Path) -> Manifest:
    """The manifest of the artifact at `path`; `BadData` if it is missing or damaged."""
    file = path / MANIFEST
    # A command may read thousands, nearly all valid: first the fast way, then the one that explains the error.
    with suppress(OSError, ValidationError), file.open("rb") as stream:
        if os.fstat(stream.fileno()).st_size <= MOST_JSON_BYTES:
            return Manifest.model_validate_json(stream.read())
    try:
        return Manifest.model_validate(read_json(file, REMAKE))
    except ValidationError as error:
        field, expected, came = first_fault(error)
        raise BadData(file, field, expected=expected, got=came, fix=REMAKE) from error


def list_files(path: Path) -> Iterator[tuple[str, Path]]:
    """Every file below `path` except the manifest, as (name with forward slashes, path), sorted by name."""
    files = []
    for folder, _, names in os.walk(path, followlinks=False):
        for name in names:
            file = Path(folder) / name
            relative = file.relative_to(path).as_posix()
            if relative != MANIFEST:
                files.append((relative, file))
    yield from sorted(files)


def seal(
    scratch: Path,
    *,
    artifact: type[Artifact],
    stage: str,
    stage_version: int,
    params: dict[str, Any],
    inputs: dict[str, str],
    key: str,
) -> Manifest:
    """Write the manifest of a finished scratch directory and sync everything to disk."""
    files = {name: FileEntry(sha256=file_digest(file), bytes=file.stat().st_size) for name, file in list_files(scratch)}
    manifest = Manifest(
        kind=artifact.kind,
        schema_version=artifact.schema_version,
        stage=stage,
        stage_version=stage_version,
        params=params,
        inputs=inputs,
        key=key,
        files=files,
        digest=content_digest(files),
    )
    (scratch / MANIFEST).write_text(manifest.model_dump_json(indent=2) + "\n")
    for name in [*files, MANIFEST]:
        _sync(scratch / name)
    for folder, _, _ in os.walk(scratch):
        _sync(Path(folder))
    return manifest


def content_digest(files: dict[str, FileEntry]) -> str:
    """Digest of an artifact's content: of its file names and their SHA-256."""
    return digest_of({name: entry.sha256 for name, entry in files.items()})


def publish(scratch: Path, target: Path) -> None:
    """Move a sealed scratch directory to its target atomically, replacing an existing artifact."""
    target.parent.mkdir(parents=True, exist_ok=True)
    if not target.exists():
        try:
            os.rename(scratch, target)
        except OSError as error:
            # Another process has published the same artifact meanwhile; it is exchanged below.
            if error.errno not in (errno.EEXIST, errno.ENOTEMPTY):
                raise
        else:
            _sync(target.parent)
            return
    _exchange(scratch, target)
    _sync(target.parent)
    shutil.rmtree(scratch, ignore_errors=True)


def _exchange(scratch: Path, target: Path) -> None:
    """Swap two directories. If the file system cannot, the old one is parked; after a kill, `recover` restores it."""
    libc = ctypes.CDLL(None, use_errno=True)
    if hasattr(libc, "renameat2"):
        done = libc.renameat2(
            _AT_FDCWD, os.fsencode(scratch), _AT_FDCWD, os.fsencode(target), ctypes.c_uint(_RENAME_EXCHANGE)
        )
        if done == 0:
            return
    parked = scratch.with_name(scratch.name + ".parked")
    parked.mkdir()
    (parked / "target").write_text(str(target))
    os.rename(target, parked / "artifact")
    os.rename(scratch, target)
    shutil.rmtree(parked, ignore_errors=True)


def new_scratch(root: Path, name: str) -> Path:
    """An empty scratch directory in the dataset, on the same file system as the future artifact."""
    scratch = root / SCRATCH / f"{name}~{socket.gethostname()}~{os.getpid()}~{uuid.uuid4().hex[:8]}"
    scratch.mkdir(parents=True)
    return scratch


def recover(root: Path) -> None:
    """Restore parked artifacts, and remove the scratch directories of processes that have ended on this host."""
    for parked in (root / SCRATCH).glob("*.parked"):
        if _is_abandoned(parked.name):
            target = Path((parked / "target").read_text()) if (parked / "target").exists() else None
            inside = target is not None and target.resolve().is_relative_to(root.resolve())
            if target is not None and inside and not target.exists() and (parked / "artifact").exists():
                os.rename(parked / "artifact", target)
            shutil.rmtree(parked, ignore_errors=True)
    for scratch in (root / SCRATCH).glob("*~*~*~*"):
        if scratch.is_dir() and _is_abandoned(scratch.name):
            shutil.rmtree(scratch, ignore_errors=True)


def _is_abandoned(name: str) -> bool:
    """Whether the process that made a scratch directory has ended. One on another host may still run."""
    parts = name.split("~")
    if len(parts) != 4 or parts[1] != socket.gethostname() or not parts[2].isdigit():
        return False
    try:
        os.kill(int(parts[2]), 0)
    except ProcessLookupError:
        return True
    except PermissionError:
        return False
    return False


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
