"""Files that ScanNet's SensReader exports: a folder for each kind, or `frame-*` files beside an info file.

The second layout is that of the reader in C++, and of 3RScan and 12-Scenes, which were recorded with the same tools.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from bask_data.errors import BadData
from bask_data.formats.files import Folder, numbers, read_lines
from bask_data.formats.intrinsics import intrinsics_matrix
from bask_data.formats.poses import parse_pose, read_pose

EXPORTED_SCALE = 0.001
"""Metres per unit of depth in folders. Source: ScanNet's SensReader, whose depthShift is 1000."""

INFO_NAMES = ("_info.txt", "info.txt")
"""Names of the info file, in ScanNet and 3RScan, and in 12-Scenes."""


@dataclass(frozen=True)
class ScanCameras:
    """Cameras of a scan.

    Args:
        depth_scale: metres per unit of depth.
        color_from_body, depth_from_body: extrinsics; the body is what the poses are of.
        files: that it was read from.
    """

    color_K: Float[ndarray, "3 3"]
    depth_K: Float[ndarray, "3 3"]
    color_from_body: Float[ndarray, "4 4"]
    depth_from_body: Float[ndarray, "4 4"]
    depth_scale: float
    files: tuple[Path, ...]


@dataclass(frozen=True)
class Export:
    """An exported scan.

    Args:
        groups: files by frame, of `color`, `depth` and `pose`.
        prefix: path of the export inside the source folder, empty or ending in a slash.
    """

    groups: dict[str, dict[str, Path]]
    calibration: ScanCameras
    prefix: str


def find_export(folder: Folder) -> Export | None:
    """The export in the source folder, or in one folder of it; None if there is none."""
    inside = sorted(path.name for path in folder.path.iterdir() if path.is_dir() and not path.name.startswith("."))
    for prefix in ("", *(f"{name}/" for name in inside)):
        if (folder.path / prefix / "color").is_dir() and (folder.path / prefix / "depth").is_dir():
            return Export(_of_folders(folder, prefix), _calibration_of_folders(folder, prefix), prefix)
        for name in INFO_NAMES:
            if folder.has(f"{prefix}{name}"):
                info = folder.member(f"{prefix}{name}", "calibration")
                return Export(_of_names(folder, prefix), _calibration_of_info(info), prefix)
    return None


def _of_folders(folder: Folder, prefix: str) -> dict[str, dict[str, Path]]:
    return {
        "color": folder.files_in(f"{prefix}color", (".jpg", ".jpeg", ".png"), "colour"),
        "depth": folder.files_in(f"{prefix}depth", (".png", ".pgm"), "depth"),
        "pose": folder.files_in(f"{prefix}pose", (".txt",), "poses"),
    }


def _of_names(folder: Folder, prefix: str) -> dict[str, dict[str, Path]]:
    """Files named `frame-000000.color.jpg` and so on, beside the info file or in `data`."""
    inside = f"{prefix}data" if (folder.path / prefix / "data").is_dir() else prefix
    return {
        "color": folder.files_in(inside, (".color.jpg", ".color.png"), "colour"),
        "depth": folder.files_in(inside, (".depth.pgm", ".depth.png"), "depth"),
        "pose": folder.files_in(inside, (".pose.txt",), "poses"),
    }


def _calibration_of_folders(folder: Folder, prefix: str) -> ScanCameras:
    """SensReader writes `intrinsic/intrinsic_color.txt`, and frames_25k has `intrinsics_color.txt`."""
    files, matrices = [], []
    for name in ("intrinsic_color", "intrinsic_depth"):
        files.append(folder.member(_place(folder, prefix, name), "intrinsics"))
        values = [value for line in read_lines(files[-1]) for value in numbers(files[-1], line)]
        matrices.append(intrinsics_matrix(files[-1], values, ""))
    for name in ("extrinsic_color", "extrinsic_depth"):
        place = _place(folder, prefix, name)
        if folder.has(place):
            files.append(folder.member(place, "extrinsics"))
        matrices.append(read_pose(files[-1]) if folder.has(place) else np.eye(4))
    color_K, depth_K, color_from_body, depth_from_body = matrices
    return ScanCameras(color_K, depth_K, color_from_body, depth_from_body, EXPORTED_SCALE, tuple(files))


def _place(folder: Folder, prefix: str, name: str) -> str:
    """Where the file of a matrix is, or where it belongs if it is nowhere."""
    plural = name.replace("insic_", "insics_")
    places = (f"{prefix}intrinsic/{name}.txt", f"{prefix}{plural}.txt", f"{prefix}{name}.txt")
    return next((place for place in places if folder.has(place)), places[0])


def _calibration_of_info(path: Path) -> ScanCameras:
    """ScanCameras from lines like `m_depthShift = 1000`."""
    stated = {key.strip(): value for key, _, value in (line.partition("=") for line in read_lines(path))}

    def values(name: str, default: str = "") -> list[float]:
        text = stated.get(name, default)
        if not text:
            raise BadData(path, name, expected="its value", got="none", fix="export the scan again.")
        return numbers(path, text)

    shift = values("m_depthShift", "1000")
    if len(shift) != 1 or not 0 < shift[0] < np.inf:
        raise BadData(path, "m_depthShift", expected="units per metre, more than 0", got=stated["m_depthShift"].strip())
    identity = "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"
    color, depth = (f"{path}: m_calibration{kind}" for kind in ("Color", "Depth"))
    return ScanCameras(
        intrinsics_matrix(f"{color}Intrinsic", values("m_calibrationColorIntrinsic"), ""),
        intrinsics_matrix(f"{depth}Intrinsic", values("m_calibrationDepthIntrinsic"), ""),
        parse_pose(f"{color}Extrinsic", values("m_calibrationColorExtrinsic", identity)),
        parse_pose(f"{depth}Extrinsic", values("m_calibrationDepthExtrinsic", identity)),
        1 / shift[0],
        (path,),
    )
