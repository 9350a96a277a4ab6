"""Dumps of colour, depth and pose files: which patterns, trajectories and calibrations a folder has."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from functools import partial
from pathlib import PurePosixPath

import numpy as np

from bask_data.formats.file_patterns import (
    POSE_WORDS,
    FilePattern,
    count_of_numbers,
    file_patterns,
    numbers_of,
    words_of,
)
from bask_data.formats.guess import Guess
from bask_data.formats.listing import Listing
from bask_data.formats.options.frames import FramesOptions
from bask_data.formats.recognise.cameras import calibration_hints, options_for_cameras

K_PLACEHOLDER = "fx,fy,cx,cy"
"""Stands in a command for intrinsics, which no file states."""

CALIBRATION_WORDS = {"intrinsic", "intrinsics", "intr", "k", "calib", "calibration", "matrix", "info", "camera"}
CALIBRATION_ENDINGS = (".txt", ".json", ".yaml", ".yml")
_FIELDS = re.compile(rb'"?(fx|fl_x|k|camera_matrix|intrinsic_matrix|cam_k|intrinsics?|camera_intrinsics)"?\s*:', re.I)

TRAJECTORY_WORDS = POSE_WORDS | {"traj", "trajectory", "groundtruth", "gt", "odometry", "odom", "keyframetrajectory"}
TRAJECTORY_ENDINGS = (".txt", ".log", ".npy", ".freiburg", ".csv")
LEAST_LINES = 3
"""Lines of poses that a file whose name does not say so must have."""

LEAST_SHARED = 0.5
"""Share of a pattern's files that must have partners of another kind to belong to the same frames."""


@dataclass(frozen=True)
class Dump:
    """What a folder holds that frames are made of; None or empty where nothing was found.

    Args:
        others: further patterns of files, that were not chosen.
    """

    color: FilePattern | None
    depth: FilePattern | None
    pose: FilePattern | None
    labels: FilePattern | None
    trajectory: str
    calibration: str
    depth_calibration: str
    others: tuple[str, ...] = field(default=())

    @property
    def has_poses(self) -> bool:
        """Whether there are poses of any kind."""
        return self.pose is not None or bool(self.trajectory)


def find_dump(listing: Listing) -> Dump:
    """The files of frames in a folder and its sub-folders."""
    patterns = file_patterns(listing)
    colors = [each for each in patterns if each.kind == "color"]
    depths = [each for each in patterns if each.kind == "depth"]
    color, depth = _best_pair(colors, depths)
    keys = color.keys if color else (depth.keys if depth else frozenset())
    partners = partial(_partner, patterns=patterns, keys=keys)
    pose, labels = partners("pose"), partners("label")
    calibrations = _calibrations(listing)
    of_depth = [path for path in calibrations if "depth" in words_of(path)]
    of_color = [path for path in calibrations if path not in of_depth]
    chosen = {each.pattern for each in (color, depth, pose, labels) if each}
    return Dump(
        color,
        depth,
        pose,
        labels,
        "" if pose else find_trajectory(listing),
        next(iter(of_color), ""),
        next(iter(of_depth), "") if of_color else "",
        tuple(each.pattern for each in [*colors, *depths] if each.pattern not in chosen),
    )


def guess_of_dump(listing: Listing, dump: Dump) -> Guess | None:
    """How `frames` reads the dump, if there are colour and depth whose names belong together, and poses."""
    if dump.color is None or dump.depth is None or not dump.has_poses:
        return None
    if not dump.color.keys & dump.depth.keys:
        return None
    wanted = {"color": dump.color.pattern, "depth": dump.depth.pattern}
    wanted["pose"] = dump.pose.pattern if dump.pose else dump.trajectory
    defaults = {name: model_field.default for name, model_field in FramesOptions.model_fields.items()}
    options = {name: pattern for name, pattern in wanted.items() if pattern != defaults[name]}
    if dump.calibration:
        options["intrinsics"] = dump.calibration
    options |= options_for_cameras(listing, options, dump.others)
    others = [] if "camera" in options else other_images(dump)
    reasons = [
        f"{len(dump.color.keys)} colour files {dump.color.pattern}",
        f"{len(dump.depth.keys)} depth files {dump.depth.pattern}",
        f"{len(dump.pose.keys)} pose files {dump.pose.pattern}" if dump.pose else f"poses in {dump.trajectory}",
        f"intrinsics in {dump.calibration}" if dump.calibration else "no file with intrinsics",
        *([f"the same of cameras {options['camera']}"] if "camera" in options else []),
        *hints_of(dump),
        *others,
        *calibration_hints(listing),
    ]
    missing = {} if dump.calibration else {"intrinsics": K_PLACEHOLDER}
    return Guess("frames", listing.root, tuple(reasons), options, missing)


def hints_of(dump: Dump) -> list[str]:
    """What else is there, and the options for it, which are not taken without being asked."""
    hints = []
    if dump.labels:
        hints.append(f"label images {dump.labels.pattern}: if they are ground truth, --labels '{dump.labels.pattern}'")
    if dump.depth_calibration:
        hints.append(
            f"intrinsics of depth in {dump.depth_calibration}: if depth is not registered to colour, "
            f"--depth-intrinsics {dump.depth_calibration}"
        )
    return hints


def other_images(dump: Dump) -> list[str]:
    """What images there are that were not chosen."""
    shown = ", ".join(dump.others[:5]) + (", ..." if len(dump.others) > 5 else "")
    return [f"images of other cameras or kinds, not read: {shown}"] if dump.others else []


def _best_pair(colors: list[FilePattern], depths: list[FilePattern]) -> tuple[FilePattern | None, FilePattern | None]:
    """The colour and depth that share most names; among equals those whose names say what they are, and the first."""
    pairs = [(color, depth) for color in colors for depth in depths]
    if not pairs:
        return _named_first(colors), _named_first(depths)
    return max(pairs, key=lambda pair: (len(pair[0].keys & pair[1].keys), pair[0].is_named, pair[1].is_named))


def _named_first(patterns: list[FilePattern]) -> FilePattern | None:
    return max(patterns, key=lambda each: (each.is_named, len(each.keys)), default=None)


def _partner(kind: str, *, patterns: list[FilePattern], keys: frozenset[str]) -> FilePattern | None:
    """The pattern of a kind that most of the frames have a file of."""
    fitting = [each for each in patterns if each.kind == kind and len(each.keys & keys) >= LEAST_SHARED * len(keys)]
    return max(fitting, key=lambda each: (len(each.keys & keys), each.is_named), default=None) if keys else None


def find_calibration(listing: Listing) -> str:
    """The file with the intrinsics of the colour camera; empty if there is none."""
    return next((path for path in _calibrations(listing) if "depth" not in words_of(path)), "")


def find_trajectory(listing: Listing, without: tuple[str, ...] = ()) -> str:
    """The file with the poses of all frames; empty if there is none."""
    return next((path for path in _trajectories(listing) if path not in without), "")


def _calibrations(listing: Listing) -> list[str]:
    """Files with intrinsics in the upper two levels, those of colour first."""
    found = []
    for folder in listing.all_folders:
        if folder.count("/") > 1:
            continue
        for name in listing.files(folder):
            stem, suffix = PurePosixPath(name).stem, PurePosixPath(name).suffix.lower()
            words = words_of(stem)
            if suffix in CALIBRATION_ENDINGS and CALIBRATION_WORDS & set(words):
                path = f"{folder}/{name}".lstrip("/")
                if _is_calibration(listing.head(path), suffix):
                    certain = not {"intrinsic", "intrinsics", "k", "intr"} & set(words)
                    found.append((certain, "color" not in words and "rgb" not in words, path.count("/"), path))
    return [path for *_, path in sorted(found)]


def _is_calibration(head: bytes, suffix: str) -> bool:
    if suffix == ".txt" and not head.lstrip().startswith((b"{", b"%")):
        return count_of_numbers(head) in (4, 8, 9, 12, 13, 14, 16, 17)
    return bool(_FIELDS.search(head))


def _trajectories(listing: Listing) -> list[str]:
    """Files with the poses of many frames, the likeliest first."""
    found = []
    for folder in listing.all_folders:
        if folder.count("/") > 1:
            continue
        for name in listing.files(folder):
            suffix = PurePosixPath(name).suffix.lower()
            if suffix not in TRAJECTORY_ENDINGS:
                continue
            is_named = bool(TRAJECTORY_WORDS & {*words_of(PurePosixPath(name).stem), PurePosixPath(name).stem.lower()})
            path = f"{folder}/{name}".lstrip("/")
            head = listing.head(path)
            is_named = is_named or suffix in (".log", ".freiburg")
            if is_trajectory(head, suffix) and (is_named or is_rigid_lines(head)):
                found.append((not is_named, path.count("/"), path))
    return [path for *_, path in sorted(found)]


def is_rigid_lines(head: bytes) -> bool:
    """Whether the lines of a file, whatever its name, are poses by their numbers: unit quaternions or rotations."""
    lines = (head.rpartition(b"\n")[0] or head).splitlines()[:20]
    rows = [numbers for line in lines if (numbers := numbers_of(line))]
    if len(rows) < LEAST_LINES or len({len(row) for row in rows}) > 1 or len(rows[0]) not in (7, 8, 12, 13, 16, 17):
        return False
    values = np.array(rows)
    if values.shape[1] in (7, 8):
        return bool(np.allclose(np.linalg.norm(values[:, -4:], axis=1), 1, atol=1e-3))
    matrices = values[:, values.shape[1] % 4 :].reshape(len(rows), -1, 4)[:, :3, :3]
    return bool(np.allclose(matrices @ matrices.swapaxes(1, 2), np.eye(3), atol=1e-3))


def is_trajectory(head: bytes, suffix: str) -> bool:
    """Whether the beginning of a file is one of poses: a pose per line, or blocks of lines of four numbers."""
    if suffix == ".npy":
        return head.startswith(b"\x93NUMPY")
    whole = head.rpartition(b"\n")[0] or head
    lengths = {n for line in whole.splitlines()[:200] if (n := count_of_numbers(line))}
    if not lengths or any(word.isalpha() for word in whole.split(b"\n")[0].split() if not whole.startswith(b"#")):
        return False
    one_per_line = len(lengths) == 1 and lengths <= {7, 8, 12, 13, 16, 17}
    return one_per_line or (4 in lengths and lengths <= {1, 2, 3, 4})
