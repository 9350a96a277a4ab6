"""Writing of exports: to a scratch folder first, then moved into place."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

from bask_data.artifact import SCRATCH, list_files, new_scratch, publish, recover
from bask_data.dataset import Dataset
from bask_data.engine import plan, sections_of, state_of
from bask_data.errors import BaskError, UsageError, WouldOverwrite
from bask_data.export.episodes import SINGLE_FILE, SPLITS, Episodes
from bask_data.export.settings import ExportSettings
from bask_data.export.table import FORMATS, ExportFormat, named
from bask_data.formats.files import listed
from bask_data.stages.encode import encode


@dataclass(frozen=True)
class Exported:
    """Summary of an export.

    Args:
        splits: names of demonstrations by split.
        columns: number of values by column.
        notes: notes for the user on the data.
    """

    path: str
    format: str
    n_frames: int
    n_bytes: int
    splits: dict[str, list[str]]
    columns: dict[str, int]
    cameras: list[str]
    notes: list[str] = field(default_factory=list)

    @property
    def opened_with(self) -> str:
        """Command that opens the export, in Python or in a shell."""
        return named(self.format).opened_with.format(path=self.path, name=Path(self.path).name)


def export(dataset: Dataset, out: Path, format: str, settings: ExportSettings, *, force: bool = False) -> Exported:
    """Export demonstrations with their keypoints; an export that is replaced stays until the new one is complete.

    Args:
        format: name of one of `FORMATS`.
        force: replace an existing export.

    Raises:
        WouldOverwrite: `out` exists; with `force`, if it is not an export.
        UsageError: `out` overlaps the dataset, or the format or a name in the settings is unknown.
        BadData: the demonstrations are inconsistent, incomplete, or lack a required column.
        MissingDependency: the format's package is not installed.
        BaskError: the files cannot be written.
    """
    writer = named(format)
    if settings.cameras and not writer.ingested:
        able = " or ".join(other.name for other in FORMATS if other.ingested)
        raise UsageError("export", "--cameras", expected=f"the format {able}", got=format, fix="pass --videos instead.")
    _refuse(dataset.root, out, writer, force)
    writer.require()
    episodes = Episodes(dataset, settings)
    for column in writer.columns:
        episodes.require(column)
    try:
        with _scratch_beside(out) as scratch:
            notes = writer.write(scratch, episodes)
            n_bytes = _sync(scratch)
            if (scratch / SINGLE_FILE).exists():
                os.replace(scratch / SINGLE_FILE, out)
            else:
                publish(scratch, out)
    except OSError as error:
        fix = "free disk space, or check the permissions of the folder."
        raise BaskError(out, "", expected="a writable location", got=str(error)[:200], fix=fix) from error
    return Exported(
        path=str(out),
        format=format,
        n_frames=episodes.n_frames,
        n_bytes=n_bytes,
        splits={split: [episodes.entries[i].name for i in episodes.in_split(split)] for split in SPLITS},
        columns={column.name: column.width for column in episodes.columns},
        cameras=list(episodes.cameras),
        notes=[*_left_out(settings), *_outdated(episodes), *_gaps(episodes), *episodes.notes, *notes],
    )


@contextmanager
def _scratch_beside(out: Path) -> Iterator[Path]:
    """A scratch folder on the same file system, removed at the end, as are those of killed exports."""
    out.parent.mkdir(parents=True, exist_ok=True)
    recover(out.parent)
    scratch = new_scratch(out.parent, "export")
    try:
        yield scratch
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
        with suppress(OSError):
            (out.parent / SCRATCH).rmdir()


def _refuse(root: Path, out: Path, format: ExportFormat, force: bool) -> None:
    """Refuse to replace anything but an export, and that only with `force`, so that a typo in OUT costs no folder."""
    dataset, target = root.resolve(), out.resolve()
    if target.is_relative_to(dataset) or dataset.is_relative_to(target):
        raise UsageError(out, "OUT", expected="a path outside the dataset", got=f"one that overlaps {root}")
    if format.is_file and out.suffix not in format.suffixes:
        raise UsageError(out, "OUT", expected=f"a name that ends in {' or '.join(format.suffixes)}", got=out.name)
    if not out.exists() and not out.is_symlink():
        return
    if not force:
        raise WouldOverwrite(out, "", expected="a new path", got="one that exists", fix="--force replaces an export.")
    if out.is_symlink() or not _is_export(out, format.is_file):
        expected = f"a {format.name} file of bask-data" if format.is_file else "an exported folder"
        raise WouldOverwrite(out, "--force", expected=expected, got="something else", fix="choose another OUT.")


def _is_export(path: Path, is_file: bool) -> bool:
    """Whether the path holds an export, by its description, in a format that is a file or a folder."""
    if path.is_file() != is_file:
        return False
    described = [(format.name, format.description(path)) for format in FORMATS if format.is_file == is_file]
    return any(isinstance(document, dict) and document.get("format") == name for name, document in described)


def _left_out(settings: ExportSettings) -> list[str]:
    """Notes on demonstrations to hold out that are not exported."""
    wanted = (("--validation", settings.validation), ("--test", settings.test))
    dropped = {
        option: [name for name in names if settings.only and name not in settings.only] for option, names in wanted
    }
    return [
        f"{option} {','.join(names)}: left out, because --only does not name it."
        for option, names in dropped.items()
        if names
    ]


def _outdated(episodes: Episodes) -> list[str]:
    """Notes on demonstrations whose keypoints are stale with the dataset's parameters, by reason."""
    encoded = [entry.name for entry in episodes.entries if episodes.track(entry.name).manifest.stage == encode.name]
    if not encoded:
        return []
    dataset, variant = episodes.dataset, episodes.settings.variant
    parameters = dataset.root / "params.yaml"
    names: dict[str, list[str]] = {}
    try:
        config = sections_of(parameters) if parameters.exists() else {}
        for task in plan(dataset, encode, config=config, only=encoded, variant=variant):
            state = state_of(task)
            if state.status != "up to date":
                names.setdefault(state.why, []).append(task.item)
    except BaskError as error:
        return [f"cannot check whether the keypoints are up to date: {error}"]
    return [
        f"{listed(stale)}: the keypoints are not up to date ({why}); see `bask-data status`."
        for why, stale in names.items()
    ]


def _gaps(episodes: Episodes) -> list[str]:
    """Notes on recordings with gaps, whose frames are exported at a constant rate."""
    return [
        f"{entry.name}: {entry.n_gaps} intervals between frames exceed 1.5 times the median of "
        f"{1 / entry.fps:.3g} s; see the column time."
        for entry in episodes.entries
        if entry.n_gaps
    ]


def _sync(folder: Path) -> int:
    """Force every file to disk; returns their size in bytes."""
    n_bytes = 0
    for _, file in list_files(folder):
        descriptor = os.open(file, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
        n_bytes += file.stat().st_size
    return n_bytes
