"""Demonstrations become an export: read once, written aside, put into place whole."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

from bask_data.artifact import SCRATCH, list_files, new_scratch, publish, recover
from bask_data.config import sections_of
from bask_data.dataset import Dataset
from bask_data.engine import plan, state_of
from bask_data.errors import BaskError, UsageError, WouldOverwrite
from bask_data.export.episodes import SINGLE_FILE, SPLITS, Episodes
from bask_data.export.settings import ExportSettings
from bask_data.export.table import FORMATS, ExportFormat, named
from bask_data.formats.files import listed
from bask_data.stages.encode import encode


@dataclass(frozen=True)
class Exported:
    """What was written.

    Args:
        splits: names of the demonstrations of each.
        columns: number of values of each.
        notes: what a person should know of the data.
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
        """What to type to look into it, in Python or in a shell."""
        return named(self.format).opened_with.format(path=self.path, name=Path(self.path).name)


def export(dataset: Dataset, out: Path, format: str, settings: ExportSettings, *, force: bool = False) -> Exported:
    """Write demonstrations and their keypoints; what is there stays until all is written.

    Args:
        format: name of one of `FORMATS`.

    Raises:
        WouldOverwrite: there is something at `out`; with `force`, if it is no export.
        UsageError: `out` lies in the dataset or holds it; or the format or an option names what does not exist.
        BadData: the demonstrations do not fit together, or hold what no policy can learn from.
        MissingDependency: the format's package is not installed.
        BaskError: the files cannot be written.
    """
    writer = named(format)
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
        fix = "see that the disk has room, and that you may write there."
        raise BaskError(out, "", expected="a place that takes all", got=str(error)[:200], fix=fix) from error
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
    """A folder on the same file system, gone at the end; those of exports that were killed go, too."""
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
    """Nothing but an export is replaced, and only when asked: a slip in OUT must not cost a folder."""
    here, there = root.resolve(), out.resolve()
    if there.is_relative_to(here) or here.is_relative_to(there):
        raise UsageError(out, "OUT", expected="a place outside of the dataset", got=f"one that shares {root}")
    if format.is_file and out.suffix not in format.suffixes:
        raise UsageError(out, "OUT", expected=f"a name that ends in {' or '.join(format.suffixes)}", got=out.name)
    if not out.exists() and not out.is_symlink():
        return
    if not force:
        raise WouldOverwrite(out, "", expected="nothing", got="something", fix="--force replaces an export.")
    if out.is_symlink() or not _is_export(out, format.is_file):
        expected = f"a {format.name} file of bask-data" if format.is_file else "an exported folder"
        raise WouldOverwrite(out, "--force", expected=expected, got="something else", fix="choose another OUT.")


def _is_export(path: Path, is_file: bool) -> bool:
    """Whether what is there says of itself that it was exported, in a format that is a file or a folder."""
    if path.is_file() != is_file:
        return False
    alike = [format for format in FORMATS if format.is_file == is_file]
    said = [(format.name, format.description(path)) for format in alike]
    return any(isinstance(one, dict) and one.get("format") == name for name, one in said)


def _left_out(settings: ExportSettings) -> list[str]:
    """Demonstrations that were to be held out, but are not among those exported."""
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
    """Demonstrations that `encode`, with the dataset's own parameters, would track anew; by what changed."""
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
        return [f"whether the keypoints are up to date cannot be told: {error}"]
    return [
        f"{listed(of)}: the keypoints are not up to date ({why}); see `bask-data status`." for why, of in names.items()
    ]


def _gaps(episodes: Episodes) -> list[str]:
    """Recordings that paused: their frames are told as if they followed each other evenly."""
    return [
        f"{entry.name}: {entry.n_gaps} times between frames are longer than one and a half of the usual "
        f"{1 / entry.fps:.3g} s; see the column time."
        for entry in episodes.entries
        if entry.n_gaps
    ]


def _sync(folder: Path) -> int:
    """Force every file to disk; how many bytes they are."""
    n_bytes = 0
    for _, file in list_files(folder):
        descriptor = os.open(file, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
        n_bytes += file.stat().st_size
    return n_bytes
