"""What single files are: bags, archives, HDF5."""

from __future__ import annotations

import zipfile
from itertools import islice
from pathlib import Path

from bask_data.errors import BadData
from bask_data.formats.guess import Guess
from bask_data.formats.listing import Listing

MAX_ZIP_NAMES = 20_000
"""Names of a zip file that are looked at."""

MAGIC = {
    ".bag": (b"#ROSBAG V", "rosbag", "a ROS 1 bag"),
    ".mcap": (b"\x89MCAP", "rosbag", "a bag in MCAP"),
    ".db3": (b"SQLite format 3", "rosbag", "storage of a ROS 2 bag"),
    ".sens": (b"\x04\x00\x00\x00", "scannet", "a ScanNet file, version 4"),
}
"""First bytes of files by their ending, the format, and the reason in words."""


def guess_of_file(path: Path) -> Guess | None:
    """The format of one file; None if it is none that is known.

    Raises:
        MissingDependency: a library that opens it is not installed.
    """
    listing, suffix = Listing(path.parent), path.suffix.lower()
    head = listing.head(path.name, 16)
    if suffix in MAGIC:
        magic, format, what = MAGIC[suffix]
        return Guess(format, path, (f"{path.name} is {what}",)) if head.startswith(magic) else None
    if suffix in (".h5", ".hdf5") and head:
        return _of_hdf5(path)
    if suffix in (".zip", ".r3d") and head.startswith(b"PK"):
        return _of_names(path, zip_names(path))
    return None


def zip_names(path: Path) -> list[str]:
    """Names of a zip file's members, as many as are looked at; none if it is damaged."""
    try:
        with zipfile.ZipFile(path) as archive:
            return list(islice(archive.namelist(), MAX_ZIP_NAMES))
    except (zipfile.BadZipFile, OSError, ValueError, RuntimeError, NotImplementedError):
        return []


def _of_names(path: Path, names: list[str]) -> Guess | None:
    if any(name.endswith("metadata") for name in names) and any("rgbd/" in name for name in names):
        return Guess("record3d", path, (f"{path.name} holds metadata and rgbd, as Record3D saves them",))
    if any("keyframes/" in name for name in names) and any("cameras/" in name for name in names):
        return Guess("polycam", path, (f"{path.name} holds keyframes, as Polycam exports them",))
    return None


def _of_hdf5(path: Path) -> Guess | None:
    from bask_data.formats.hdf5 import Hdf5File

    try:
        file = Hdf5File(path)
        top = file.members()
        demos = [name for name in file.members("data") if name.startswith("demo")] if "data" in top else []
    except BadData:
        return None
    trajectories = [name for name in top if name.startswith("traj_")]
    if trajectories:
        return Guess("maniskill", path, (f"groups {trajectories[0]} ... of ManiSkill",), has_robot=True)
    if demos:
        return Guess("robomimic", path, (f"groups data/{demos[0]} ... of robomimic",), has_robot=True)
    return None
