"""Instance labels of ScanNet: 8-bit images from its archives of 2D annotations, and the instances' names."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from jaxtyping import UInt8
from numpy import ndarray

from bask_data.errors import BadData
from bask_data.formats.files import Folder, listed, natural
from bask_data.formats.images import image_header, read_labels
from bask_data.formats.json_values import read_json
from bask_data.formats.label_files import labels_in

LABEL_FOLDERS = ("instance-filt", "instance")
"""Folders of instance labels, the best first, as ScanNet's archives of 2D annotations unpack."""


@dataclass(frozen=True)
class InstanceLabels:
    """Labels of instances in colour's images.

    Args:
        files: by frame; empty if there are none that can be used.
        names: of the labels that occur.
        name_files: files that state the names.
        statement: what is said about them in the assumptions.
    """

    files: tuple[Path, ...]
    names: dict[int, str]
    name_files: tuple[Path, ...]
    statement: str

    def read(self, i: int) -> UInt8[ndarray, "h w"]:
        """Labels of a frame."""
        return read_labels(self.files[i])


def instance_labels(folder: Folder, prefix: str, frames: list[str]) -> InstanceLabels:
    """The labels beside the frames; none if some frames lack them, as half a truth would pass for a whole one.

    Args:
        prefix: path of the exported folder inside the source folder, empty or ending in a slash.
    """
    inside = next((f"{prefix}{name}" for name in LABEL_FOLDERS if (folder.path / prefix / name).is_dir()), None)
    if inside is None:
        return InstanceLabels((), {}, (), "none found")
    files = folder.files_in(inside, (".png",), "labels")
    lacking = [name for name in frames if name not in files]
    bits = image_header(next(iter(files.values()))).bits
    if lacking or bits != 8:
        why = f"frames {listed(lacking)} lack them" if lacking else f"{bits} bits instead of 8"
        return InstanceLabels((), {}, (), f"{inside} is not taken as truth: {why}")
    files = {name: files[name] for name in frames}
    stated, name_files = _instance_names(folder)
    label_names = {label: stated.get(label, f"instance {label}") for label in labels_in(files.values())}
    statement = f"instances of {inside}, taken as truth for reports only"
    return InstanceLabels(tuple(files.values()), label_names, tuple(name_files), statement)


def _instance_names(folder: Folder) -> tuple[dict[int, str], list[Path]]:
    """Names of instances by label, from the annotation beside the scan, if any: labels count from 1, its ids from 0."""
    found = sorted((path.name for path in folder.path.glob("*.aggregation.json")), key=natural)
    if not found:
        return {}, []
    path = folder.member(found[-1], "names of instances")
    document = read_json(path)
    try:
        groups = document["segGroups"]
        names = {int(group["objectId"]) + 1: str(group["label"]) for group in groups}
    except (ValueError, KeyError, TypeError, OverflowError) as error:
        raise BadData(path, "segGroups", expected="objectId and label in each", got=repr(error)) from error
    counts: dict[str, int] = {}
    for label, name in sorted(names.items()):
        counts[name] = counts.get(name, 0) + 1
        names[label] = name if counts[name] == 1 else f"{name} ({counts[name]})"
    return names, [path]
