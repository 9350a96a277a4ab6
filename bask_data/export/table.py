"""The table of formats of `bask-data export`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from types import ModuleType

from bask_data.errors import UsageError, imported
from bask_data.export.description import read_description
from bask_data.export.episodes import Episodes


@dataclass(frozen=True)
class ExportFormat:
    """A format that `bask-data export <name>` writes, in the module `bask_data.export.<name>`.

    Args:
        name: name on the command line; hyphens are underscores in the module's name.
        help: the files in a few words.
        opened_with: command that opens an export; `{path}` is its path and `{name}` the last part of it.
        suffixes: suffixes of OUT for a format that is a single file; empty for a folder.
        columns: required columns; demonstrations without them are refused.
        packages: required modules of the extra `export`.
        ingested: whether `ingest` reads what `--cameras` adds; other formats refuse that option.
    """

    name: str
    help: str
    opened_with: str
    suffixes: tuple[str, ...] = ()
    columns: tuple[str, ...] = ()
    packages: tuple[str, ...] = ()
    ingested: bool = False

    @property
    def is_file(self) -> bool:
        """Whether OUT is a single file."""
        return bool(self.suffixes)

    def write(self, out: Path, episodes: Episodes) -> list[str]:
        """Fill the folder `out`, with a single file named `SINGLE_FILE`; returns notes for the user."""
        notes: list[str] = self._module().write(out, episodes)
        return notes

    def description(self, path: Path) -> object:
        """The description of an export at `path`; None or another object if it is not an export of this format."""
        read: Callable[[Path], object] = getattr(self._module(), "description", read_description)
        return read(path)

    def require(self) -> None:
        """Raise `MissingDependency` if a required package is not installed."""
        for package in self.packages:
            imported(package, package, user="export", extra="export")

    def _module(self) -> ModuleType:
        return import_module(f"bask_data.export.{self.name.replace('-', '_')}")


FORMATS = (
    ExportFormat("parquet", "tables", 'pyarrow.parquet.read_table("{path}/frames.parquet")'),
    ExportFormat("lerobot", "dataset v3", 'LeRobotDataset("local/{name}", root="{path}")', ingested=True),
    ExportFormat(
        "robomimic",
        "HDF5",
        'python -m robomimic.scripts.get_dataset_info --dataset "{path}"',
        suffixes=(".hdf5", ".h5"),
        columns=("action",),
        packages=("h5py",),
        ingested=True,
    ),
    ExportFormat("diffusion-policy", "replay buffer", 'ReplayBuffer.copy_from_path("{path}")', columns=("action",)),
)


def named(name: str) -> ExportFormat:
    """The format with a name; `UsageError` if there is none."""
    for format in FORMATS:
        if format.name == name:
            return format
    known = ", ".join(format.name for format in FORMATS)
    raise UsageError("export", "format", expected=f"one of {known}", got=name)
