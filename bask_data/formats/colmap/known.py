"""Known poses of a model's images: `--align-to`."""

from __future__ import annotations

import re
from pathlib import Path, PurePosixPath

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from bask_data.core.trajectory import interpolated
from bask_data.errors import BadData
from bask_data.formats.files import Folder, frame_number, listed, numbers, read_lines
from bask_data.formats.json_values import array, read_json
from bask_data.formats.options.colmap import ColmapOptions
from bask_data.formats.poses import parse_transform, pose_values, rigid, to_world_from_camera

LEAST_POSES = 3
"""Known poses that are needed, at least: two give a scale, and nothing tells whether they are right."""

MAX_GAP = 0.1
"""Seconds between two known poses, beyond which the camera is unknown between them: trackers run at 10 Hz and more, and
a hand moves 2 mm off the straight line meanwhile. Sensitivity not measured."""


def known_poses(
    folder: Folder, names: list[str], options: ColmapOptions
) -> tuple[dict[str, Float[ndarray, "4 4"]], tuple[Path, ...]]:
    """world_from_camera, OpenCV, metres, of those images whose poses `--align-to` states; and the files.

    Raises:
        BadData: the file holds no poses, those of fewer than three images, or one that is not rigid.
    """
    written, files = _written(folder, options)
    of_image = _by_image(names, written)
    if not of_image:
        of_image = _by_time(files[0], names, written)
    of_image = {name: pose for name, pose in of_image.items() if np.isfinite(pose).all()}
    if len(of_image) < LEAST_POSES:
        raise BadData(
            files[0],
            "--align-to",
            expected=f"poses of {LEAST_POSES} images or more",
            got=f"{len(of_image)}; images: {listed(names, 2)}; entries: {listed(list(written), 2)}",
            fix="begin each entry with an image's name, its number, or the time in its name.",
        )
    poses, _, further = to_world_from_camera(np.stack(list(of_image.values())), options, folder=folder)
    poses = np.stack([rigid(f"{files[0]}: {name}", pose) for name, pose in zip(of_image, poses, strict=True)])
    return dict(zip(of_image, poses, strict=True)), (*files, *further)


def _written(folder: Folder, options: ColmapOptions) -> tuple[dict[str, Float[ndarray, "4 4"]], tuple[Path, ...]]:
    """Poses as written, by the names written there."""
    if "*" in options.align_to:
        found = folder.matching(options.align_to, "align-to")
        read = {name: parse_transform(path, pose_values(path), options.quat) for name, path in found.items()}
        return read, tuple(found.values())
    path = Path(options.align_to)
    path = path if path.is_file() else folder.member(options.align_to, "--align-to")
    poses = {}
    if path.suffix.lower() == ".json":
        for name, value in read_json(path).items():
            flat = array(path, name, value, ((4, 4), (3, 4), (16,), (12,), (7,))).ravel().tolist()
            poses[name] = parse_transform(f"{path}: {name}", flat, options.quat)
    else:
        for line in read_lines(path):
            name, *rest = re.split(r"[\s,;]+", line, maxsplit=1)
            poses[name] = parse_transform(f"{path}: {name}", numbers(path, " ".join(rest)), options.quat)
    return poses, (path,)


def _by_image(names: list[str], written: dict[str, Float[ndarray, "4 4"]]) -> dict[str, Float[ndarray, "4 4"]]:
    """Poses whose entry bears an image's path or name, with or without its ending, or else its number."""
    spellings = (
        lambda name: name,
        lambda name: PurePosixPath(name).with_suffix("").as_posix(),
        lambda name: PurePosixPath(name).name,
        lambda name: PurePosixPath(name).stem,
        lambda name: str(frame_number(PurePosixPath(name).stem)),
    )
    numbered = {str(int(name)): pose for name, pose in written.items() if name.isascii() and name.isdecimal()}
    for spelling in spellings:
        spelled = [spelling(name) for name in names]
        entries = numbered if spelling is spellings[-1] else written
        found = {name: entries[key] for name, key in zip(names, spelled, strict=True) if key in entries}
        if found and len(set(spelled)) == len(names):
            return found
    return {}


def _by_time(
    path: Path, names: list[str], written: dict[str, Float[ndarray, "4 4"]]
) -> dict[str, Float[ndarray, "4 4"]]:
    """Poses at the times in the images' names, between those written; empty if names or entries are no times."""
    try:
        time = np.array([float(PurePosixPath(name).stem) for name in names])
        known = {float(key): rigid(f"{path}: {key}", pose) for key, pose in written.items() if np.isfinite(pose).all()}
    except ValueError:
        return {}
    if not known or not np.isfinite([*known]).all():
        return {}
    order = sorted(known)
    poses, is_known = interpolated(time, np.array(order), np.stack([known[key] for key in order]), MAX_GAP)
    return {name: poses[i] for i, name in enumerate(names) if is_known[i]}
