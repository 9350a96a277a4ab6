"""Sequences in the layout of the TUM RGB-D benchmark: text lists of timestamped files, joined by time."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from bask_data.core.lens import Lens
from bask_data.errors import BadData
from bask_data.formats.files import Folder, numbers, read_lines, source_folder
from bask_data.formats.image_files import ImageFiles
from bask_data.formats.intrinsics import parse_intrinsics
from bask_data.formats.options.tum import TumOptions
from bask_data.formats.poses import other_readings, parse_transform, to_world_from_camera
from bask_data.formats.recording import RobotRecording, SourceCamera, SourceRecording

INTRINSICS = {
    "freiburg1": "517.3,516.5,318.6,255.3",
    "freiburg2": "520.9,521.0,325.1,249.7",
    "freiburg3": "535.4,539.2,320.1,247.6",
}
"""The benchmark's published intrinsics fx, fy, cx, cy, pixels, of the colour cameras of its three rigs."""


def read(source: Path, options: TumOptions) -> SourceRecording:
    """The frames in `source` for which colour, depth and pose are close enough in time."""
    folder = source_folder(source, options.follow_links)
    color_time, color_files = _file_list(folder, "rgb.txt")
    depth_time, depth_files = _file_list(folder, "depth.txt")
    pose_time, poses = _pose_list(folder, "groundtruth.txt", options.quat)
    depth_of = mutual_nearest(color_time, depth_time, options.max_time_difference)
    pose_of = nearest(color_time, pose_time, options.max_time_difference)
    used = np.flatnonzero((depth_of >= 0) & (pose_of >= 0))
    if used.size == 0:
        raise BadData(
            source,
            "timestamps",
            expected=f"colour, depth and pose within {options.max_time_difference:g} s",
            got=f"none of {len(color_time)} colour images",
            fix="check that the clocks agree, or pass a larger --max-time-difference.",
        )
    K, intrinsics_files = parse_intrinsics(folder, INTRINSICS.get(options.intrinsics, options.intrinsics))
    color = tuple(folder.member(color_files[i], "rgb.txt") for i in used)
    depth = tuple(folder.member(depth_files[i], "depth.txt") for i in depth_of[used])
    images = ImageFiles(color, depth)
    poses = poses[pose_of[used]]
    world_from_cameras, world_from_gripper, hand_eye = to_world_from_camera(poses, options, folder=folder)
    camera = SourceCamera(
        name=options.camera,
        frames=tuple(color_files[i] for i in used),
        lens=Lens(K, images.size),
        world_from_cameras=world_from_cameras,
        time=color_time[used],
        color=images.read_color,
        depth=images.read_depth,
        depth_scale=options.depth_scale,
        pose_places=tuple(f"{source / 'groundtruth.txt'}: time {pose_time[k]:.6f}" for k in pose_of[used]),
        intrinsics_size=options.intrinsics_size,
        otherwise=other_readings(poses, options, folder=folder),
    )
    return SourceRecording(
        cameras=(camera,),
        robot=None if world_from_gripper is None else RobotRecording(world_from_gripper),
        label_names={},
        assumptions=_assumptions(options, len(color_time), used.size),
        files=(
            *(source / name for name in ("rgb.txt", "depth.txt", "groundtruth.txt")),
            *intrinsics_files,
            *hand_eye,
            *color,
            *depth,
        ),
    )


def nearest(time: Float[ndarray, " n"], other: Float[ndarray, " m"], limit: float) -> Int[ndarray, " n"]:
    """Index of the nearest of the other times, seconds, which ascend; -1 if it is more than `limit` away."""
    after = np.clip(np.searchsorted(other, time), 0, len(other) - 1)
    before = np.maximum(after - 1, 0)
    index = np.where(np.abs(other[before] - time) <= np.abs(other[after] - time), before, after)
    return np.where(np.abs(other[index] - time) <= limit, index, -1)


def mutual_nearest(time: Float[ndarray, " n"], other: Float[ndarray, " m"], limit: float) -> Int[ndarray, " n"]:
    """As `nearest`, for pairs that are each other's nearest only, so that no depth image is used twice."""
    forth, back = nearest(time, other, limit), nearest(other, time, limit)
    return np.where((forth >= 0) & (back[forth] == np.arange(len(time))), forth, -1)


def _assumptions(options: TumOptions, n_color: int, n_used: int) -> dict[str, str]:
    limit = f"{options.max_time_difference:g} s"
    return {
        "frames": f"{n_used} of {n_color} colour images have depth and pose within {limit}; the others are left out",
        "pose": "groundtruth.txt holds world_from_camera of the colour camera, metres, OpenCV axes, x y z w; "
        "the nearest in time, not interpolated",
        "depth": f"z-depth registered to colour, {options.depth_scale:g} m per unit, 0 = no measurement",
        "intrinsics": f"{options.intrinsics}, for colour and depth alike, no lens distortion",
        "time": "timestamps of rgb.txt, seconds",
    }


def _file_list(folder: Folder, name: str) -> tuple[Float[ndarray, " n"], list[str]]:
    path = folder.member(name, name)
    words = [line.split(maxsplit=1) for line in read_lines(path)]
    if not words or any(len(line) != 2 for line in words):
        raise BadData(path, "lines", expected="`timestamp file` in each", got=f"{len(words)} lines, some without")
    time = np.array([numbers(path, stamp)[0] for stamp, _ in words], dtype=np.float64)
    _check_ascending(path, time)
    return time, [file for _, file in words]


def _pose_list(folder: Folder, name: str, quat: str) -> tuple[Float[ndarray, " n"], Float[ndarray, "n 4 4"]]:
    path = folder.member(name, name)
    rows = [numbers(path, line) for line in read_lines(path)]
    if not rows or any(len(row) != 8 for row in rows):
        raise BadData(
            path, "lines", expected="`timestamp tx ty tz qx qy qz qw` in each", got=f"{len(rows)} lines, some without"
        )
    time = np.array([row[0] for row in rows])
    _check_ascending(path, time)
    return time, np.stack([parse_transform(f"{path}: time {row[0]:.6f}", row[1:], quat) for row in rows])


def _check_ascending(path: Path, time: Float[ndarray, " n"]) -> None:
    if not (np.isfinite(time).all() and (np.diff(time) > 0).all()):
        bad = int(np.argmin(np.isfinite(time) & (np.diff(time, prepend=-np.inf) > 0)))
        raise BadData(
            path,
            "timestamps",
            expected="finite times that increase from line to line",
            got=f"{time[bad]:g} s in data line {bad + 1}",
            fix="sort the lines by time, and remove duplicates.",
        )
