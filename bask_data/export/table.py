"""The table of formats: what `bask-data export` can write."""

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
        name: as it is typed; a hyphen is an underscore in the module's name.
        help: what the files are, in a few words.
        opened_with: what to type to look into an export; `{path}` is its place and `{name}` the last part of it.
        suffixes: endings of OUT where the format is a single file; none for a folder.
        columns: what a policy cannot be learned without: refused where the demonstrations lack it.
        packages: modules of the extra `export` that are needed, as they are imported.
    """

    name: str
    help: str
    opened_with: str
    suffixes: tuple[str, ...] = ()
    columns: tuple[str, ...] = ()
    packages: tuple[str, ...] = ()

    @property
    def is_file(self) -> bool:
        """Whether OUT is a single file."""
        return bool(self.suffixes)

    def write(self, out: Path, episodes: Episodes) -> list[str]:
        """Fill the folder `out`, a single file as `SINGLE_FILE`; notes for a person."""
        notes: list[str] = self._module().write(out, episodes)
        return notes

    def description(self, path: Path) -> object:
        """What an export at `path` says of itself; None or anything else where it is no export of this format."""
        read: Callable[[Path], object] = getattr(self._module(), "description", read_description)
        return read(path)

    def require(self) -> None:
        """Raise `MissingDependency` where a package is not installed."""
        for package in self.packages:
            imported(package, package, user="export", extra="export")

    def _module(self) -> ModuleType:
        return import_module(f"bask_data.export.{self.name.replace('-', '_')}")


FORMATS = (
    ExportFormat("parquet", "tables", 'pyarrow.parquet.read_table("{path}/frames.parquet")'),
    ExportFormat("lerobot", "dataset v3", 'LeRobotDataset("local/{name}", root="{path}")'),
    ExportFormat(
        "robomimic",
        "HDF5",
        'python -m robomimic.scripts.get_dataset_info --dataset "{path}"',
        suffixes=(".hdf5", ".h5"),
        columns=("action",),
        packages=("h5py",),
    ),
    ExportFormat("diffusion-policy", "replay buffer", 'ReplayBuffer.copy_from_path("{path}")', columns=("action",)),
)


def named(name: str) -> ExportFormat:
    """The format of that name; `UsageError` where there is none."""
    for format in FORMATS:
        if format.name == name:
            return format
    known = ", ".join(format.name for format in FORMATS)
    raise UsageError("export", "format", expected=f"one of {known}", got=name)
