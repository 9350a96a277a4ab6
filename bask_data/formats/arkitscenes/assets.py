"""Files of ARKitScenes by time: images, the intrinsics and the pose of each."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray
from scipy.spatial.transform import Rotation

from bask_data.core.geometry import invert_rigid
from bask_data.core.time_pairs import nearest
from bask_data.core.trajectory import interpolated
from bask_data.errors import BadData
from bask_data.formats.clock import seconds
from bask_data.formats.files import Folder, numbers, read_lines
from bask_data.formats.images import image_header
from bask_data.formats.intrinsics import intrinsics_matrix
from bask_data.formats.stated_images import intrinsics_of

SAME_STAMP = 0.00105
"""Largest difference, seconds, between the stamps of one moment in two files: names are rounded to milliseconds, some
of them down, which the data set's own loader allows for."""

GAP_SHARE = 1.5
"""Longest gap between two poses that is bridged, in usual intervals: a missing pose makes one of two. Chosen,
sensitivity not measured."""


@dataclass(frozen=True)
class Asset:
    """Files of one kind, in the order of their times, seconds."""

    folder: Path
    names: tuple[str, ...]
    files: tuple[Path, ...]
    time: Float[ndarray, " n"]


@dataclass(frozen=True)
class ImagePoses:
    """Poses of the images; not finite where none is known.

    Args:
        why: of each image without a pose, by index.
    """

    path: Path
    world_from_cameras: Float[ndarray, "t 4 4"]
    why: dict[int, BadData]
    statement: str


def read_asset(folder: Folder, prefix: str, name: str, endings: tuple[str, ...]) -> Asset:
    """The files in a folder of the data set, which are named `<video>_<seconds>`."""
    if not (folder.path / prefix / name).is_dir():
        is_packed = folder.has(f"{prefix}{name}.zip")
        raise BadData(
            folder.path / prefix / name,
            "folder",
            expected=f"{name}, unpacked",
            got=f"{name}.zip" if is_packed else "none",
            fix="unpack it there." if is_packed else "download this asset of the video, or choose another one.",
        )
    found = folder.files_in(f"{prefix}{name}", endings, name)
    time = np.array([_stamp(path, stem) for stem, path in found.items()])
    order = np.argsort(time, kind="stable")
    names, files = list(found), list(found.values())
    return Asset(
        folder.path / prefix / name, tuple(names[k] for k in order), tuple(files[k] for k in order), time[order]
    )


def _stamp(path: Path, stem: str) -> float:
    try:
        stamp = float(stem.rsplit("_", 1)[-1])
    except ValueError:
        stamp = np.nan
    if not np.isfinite(stamp):
        raise BadData(path, "name", expected="VIDEO_SECONDS", got=stem, fix="remove what is no file of the data set.")
    return stamp


def image_size(path: Path) -> tuple[int, int]:
    """(height, width) of an image file, pixels."""
    header = image_header(path)
    return header.height, header.width


def poses_at(path: Path, time: Float[ndarray, " t"], max_gap: float | None) -> ImagePoses:
    """Poses at these times, as they stand in the file where stamps are the same, otherwise interpolated.

    Args:
        time: seconds.
        max_gap: seconds between two poses, beyond which nothing between them is known; None for `GAP_SHARE`.
    """
    rows = [numbers(path, line) for line in read_lines(path)]
    if not rows or any(len(row) != 7 or not np.isfinite(row).all() for row in rows):
        expected = "finite numbers `time rx ry rz tx ty tz` in each"
        raise BadData(path, "lines", expected=expected, got=f"{len(rows)} lines, some without")
    table = np.array(rows)
    pose_time = seconds(table[:, 0], path, range(1, len(rows) + 1), unit="s", option="").time
    camera_from_world = np.tile(np.eye(4), (len(rows), 1, 1))
    camera_from_world[:, :3, :3] = Rotation.from_rotvec(table[:, 1:4]).as_matrix()
    camera_from_world[:, :3, 3] = table[:, 4:]
    interval = float(np.median(np.diff(pose_time))) if len(rows) > 1 else 0.0
    gap = GAP_SHARE * interval if max_gap is None else max_gap
    same = nearest(time, pose_time, SAME_STAMP)
    wanted = np.where(same >= 0, pose_time[same], time)
    poses, is_known = interpolated(wanted, pose_time, invert_rigid(camera_from_world), gap)
    why = {
        int(i): BadData(
            path,
            f"time {time[i]:.3f}",
            expected=f"a pose before and after it, at most {gap:.3g} s apart",
            got=f"poses from {pose_time[0]:.3f} to {pose_time[-1]:.3f}, and none so near",
        )
        for i in np.flatnonzero(~is_known)
    }
    n_between = int((is_known & (same < 0)).sum())
    statement = f"camera_from_world as axis and angle in {path.name}, metres, OpenCV axes; inverted"
    if n_between:
        statement += f"; {n_between} of {len(time)} interpolated on SE(3) between poses {interval:.3g} s apart"
    return ImagePoses(path, poses, why, statement)


def intrinsics_at(
    asset: Asset, time: Float[ndarray, " t"], size: tuple[int, int]
) -> tuple[Float[ndarray, "*t 3 3"], Bool[ndarray, " t"], list[int]]:
    """K at these times, pixels; whether there is one for each; and indices of the files they are from."""
    file_of = nearest(time, asset.time, SAME_STAMP)
    used = sorted({*file_of.tolist()} - {-1})
    if not used:
        raise BadData(
            asset.folder, "intrinsics", expected="those of the images", got=f"none at any of {len(time)} times"
        )
    K_of = {k: _pincam(asset.files[k], size) for k in used}
    return intrinsics_of([K_of.get(k) for k in file_of.tolist()]), file_of >= 0, used


def _pincam(path: Path, size: tuple[int, int]) -> Float[ndarray, "3 3"]:
    """K from `width height fx fy cx cy`."""
    values = [value for line in read_lines(path) for value in numbers(path, line)]
    if len(values) != 6:
        raise BadData(path, "intrinsics", expected="width height fx fy cx cy", got=f"{len(values)} numbers")
    if values[1] != size[0] or values[0] != size[1]:
        expected, got = f"of images of {size[1]} x {size[0]}", f"{values[0]:g} x {values[1]:g}"
        raise BadData(path, "intrinsics", expected=expected, got=got, fix="do not resize images of the data set.")
    return intrinsics_matrix(path, values[2:], "")
