"""Encoded demonstrations as the files that policies are learned from."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any, Literal, get_args

from bask_data.artifact import SCRATCH, list_files, new_scratch, publish, read_json, recover
from bask_data.config import sections_of
from bask_data.dataset import Dataset
from bask_data.errors import BadData, BaskError, UsageError, WouldOverwrite
from bask_data.export.episodes import SPLITS, Choice, Episodes
from bask_data.formats.files import listed
from bask_data.stage import plan, state_of
from bask_data.stages.encode import encode

__all__ = ["DESCRIPTION", "Choice", "Exported", "FormatName", "export"]

FormatName = Literal["parquet", "lerobot", "robomimic", "diffusion-policy"]

DESCRIPTION = "bask.json"
"""File in an exported folder that says what its numbers mean."""

FILE = "file"
"""Name of an export that is a single file, until it has its own."""

HDF5 = (".hdf5", ".h5")


@dataclass(frozen=True)
class Exported:
    """What was written.

    Args:
        splits: names of the demonstrations of each.
        columns: number of values of each.
        notes: what a person should know of the data.
    """

    path: str
    format: FormatName
    n_frames: int
    n_bytes: int
    splits: dict[str, list[str]]
    columns: dict[str, int]
    cameras: list[str]
    notes: list[str] = field(default_factory=list)

    @property
    def opened_with(self) -> str:
        """What to type to look into it, in Python or in a shell."""
        return {
            "parquet": f'pyarrow.parquet.read_table("{self.path}/frames.parquet")',
            "lerobot": f'LeRobotDataset("local/{Path(self.path).name}", root="{self.path}")',
            "robomimic": f'python -m robomimic.scripts.get_dataset_info --dataset "{self.path}"',
            "diffusion-policy": f'ReplayBuffer.copy_from_path("{self.path}")',
        }[self.format]


def export(dataset: Dataset, out: Path, format: FormatName, choice: Choice, *, force: bool = False) -> Exported:
    """Write demonstrations and their keypoints; what is there stays until all is written.

    Raises:
        WouldOverwrite: there is something at `out`; with `force`, if it is no export.
        UsageError: `out` lies in the dataset or holds it; or an option names what does not exist.
        BadData: the demonstrations do not fit together, or hold what no policy can learn from.
        MissingDependency: the format's package is not installed.
        BaskError: the files cannot be written.
    """
    _refuse(dataset.root, out, format, force)
    episodes = Episodes(dataset, choice)
    writer = import_module(f"bask_data.export.{format.replace('-', '_')}")
    try:
        with _scratch_beside(out) as scratch:
            notes = writer.write(scratch, episodes)
            n_bytes = _sync(scratch)
            if (scratch / FILE).exists():
                os.replace(scratch / FILE, out)
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
        notes=[*_left_out(choice), *_outdated(episodes), *_gaps(episodes), *episodes.notes, *notes],
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


def write_description(folder: Path, described: dict[str, Any]) -> None:
    """Say in an exported folder what its numbers mean."""
    (folder / DESCRIPTION).write_text(json.dumps(described, indent=2, ensure_ascii=False, allow_nan=False) + "\n")


def _refuse(root: Path, out: Path, format: FormatName, force: bool) -> None:
    """Nothing but an export is replaced, and only when asked: a slip in OUT must not cost a folder."""
    here, there = root.resolve(), out.resolve()
    if there.is_relative_to(here) or here.is_relative_to(there):
        raise UsageError(out, "OUT", expected="a place outside of the dataset", got=f"one that shares {root}")
    if format == "robomimic" and out.suffix not in HDF5:
        raise UsageError(out, "OUT", expected=f"a name that ends in {' or '.join(HDF5)}", got=out.name)
    if not out.exists() and not out.is_symlink():
        return
    if not force:
        raise WouldOverwrite(out, "", expected="nothing", got="something", fix="--force replaces an export.")
    is_file = format == "robomimic"
    known = _is_our_hdf5(out) if is_file else _is_our_folder(out)
    if not known or out.is_symlink():
        expected = "a robomimic file of bask-data" if is_file else "an exported folder"
        raise WouldOverwrite(out, "--force", expected=expected, got="something else", fix="choose another OUT.")


def _is_our_folder(folder: Path) -> bool:
    """Whether it says that it was exported; Zarr, which knows no files but its own, says so in its attributes."""
    for file in (folder / DESCRIPTION, folder / ".zattrs"):
        with suppress(BadData):
            said = read_json(file) if file.is_file() else None
            if file.name != DESCRIPTION:
                said = said.get("bask") if isinstance(said, dict) else None
            if _is_description(said):
                return True
    return False


def _is_our_hdf5(file: Path) -> bool:
    """Whether it is HDF5 and holds, itself and not by a link, the text that says what its numbers mean."""
    from bask_data.export.robomimic import import_h5py

    h5py = import_h5py()
    if not file.is_file() or not h5py.is_hdf5(file):
        return False
    # Whatever a damaged or a foreign file makes the library raise: it is not known to be ours.
    with suppress(Exception), h5py.File(file, "r") as opened:
        return isinstance(opened.get("bask", getlink=True), h5py.HardLink) and _is_description(
            json.loads(opened["bask"].asstr()[()])
        )
    return False


def _is_description(said: object) -> bool:
    return isinstance(said, dict) and said.get("format") in get_args(FormatName)


def _left_out(choice: Choice) -> list[str]:
    """Demonstrations that were to be held out, but are not among those exported."""
    wanted = (("--validation", choice.validation), ("--test", choice.test))
    dropped = {option: [name for name in names if choice.only and name not in choice.only] for option, names in wanted}
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
    dataset, variant = episodes.dataset, episodes.choice.variant
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
