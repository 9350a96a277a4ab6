"""A folder of colour, depth and pose files: 7-Scenes, 3DMatch, and custom dumps."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from bask_data.core.geometry import invert_rigid
from bask_data.errors import BadData
from bask_data.formats.agreement import agreement
from bask_data.formats.camera import (
    OPENCV_FROM_OPENGL,
    ImageFiles,
    camera_recording,
    parse_intrinsics,
    parse_pose,
    read_poses,
)
from bask_data.formats.files import frame_number, matching, member, numbers, paired, read_lines, source_folder
from bask_data.formats.options import FramesOptions
from bask_data.formats.recording import SourceRecording


def read(source: Path, options: FramesOptions) -> SourceRecording:
    """The recording in `source`; see `FramesOptions` for how the files are interpreted."""
    source_folder(source)
    groups = {"color": matching(source, options.color, "color"), "depth": matching(source, options.depth, "depth")}
    if "*" in options.pose:
        groups["pose"] = matching(source, options.pose, "pose")
    names = paired(source, groups)
    color, depth = (tuple(groups[kind][name] for name in names) for kind in ("color", "depth"))
    if "*" in options.pose:
        pose_files = [groups["pose"][name] for name in names]
        poses = read_poses(pose_files)
    else:
        pose_files = [member(source, options.pose, "--pose")]
        poses = _poses_of_lines(pose_files[0], names)
    K, intrinsics_files = parse_intrinsics(source, options.intrinsics)
    clock = _clock(source, names, options)
    camera = camera_recording(
        options.camera,
        ImageFiles(color, depth, invalid_depth=_raw_values(options.invalid_depth)),
        K,
        options.intrinsics_size,
        options.depth_scale,
        to_world_from_camera(poses, options.pose_is, options.axes),
        clock.time,
    )
    return SourceRecording(
        cameras=(camera,),
        robot=None,
        label_names={},
        assumptions=_assumptions(options, clock.assumption)
        | {"agreement": agreement(camera, _otherwise(poses, options))},
        files=(*color, *depth, *pose_files, *intrinsics_files, *clock.files),
    )


def to_world_from_camera(poses: Float[ndarray, "t 4 4"], pose_is: str, axes: str) -> Float[ndarray, "t 4 4"]:
    """world_from_camera of OpenCV cameras.

    Args:
        poses: transforms in the direction and for the camera axes stated by `FramesOptions.pose_is` and `.axes`.
    """
    world_from_cameras = invert_rigid(poses) if pose_is == "camera_from_world" else poses
    return world_from_cameras @ OPENCV_FROM_OPENGL if axes == "opengl" else world_from_cameras


def _otherwise(poses: Float[ndarray, "t 4 4"], options: FramesOptions) -> dict[str, Float[ndarray, "t 4 4"]]:
    """The poses under the three other interpretations, by the options for them."""
    return {
        f"--pose-is {pose_is} --axes {axes}": to_world_from_camera(poses, pose_is, axes)
        for pose_is in ("world_from_camera", "camera_from_world")
        for axes in ("opencv", "opengl")
        if (pose_is, axes) != (options.pose_is, options.axes)
    }


def _raw_values(text: str) -> tuple[int, ...]:
    return tuple(int(word) for word in text.split(",") if word)


def _poses_of_lines(path: Path, names: list[str]) -> Float[ndarray, "t 4 4"]:
    """Poses from a file with one per line, in the order of frames or with the frame's number before seven numbers."""
    rows = [numbers(path, line) for line in read_lines(path)]
    if rows and all(len(row) == 8 for row in rows):
        by_number = {row[0]: row[1:] for row in rows}
        missing = [name for name in names if frame_number(name) not in by_number]
        if missing:
            raise BadData(
                path, "pose", expected="a line for every frame", got=f"none that starts with the number of {missing[0]}"
            )
        rows = [by_number[float(frame_number(name) or 0)] for name in names]
    if len(rows) != len(names):
        raise BadData(path, "pose", expected=f"a line for each of {len(names)} frames", got=f"{len(rows)} lines")
    return np.stack([parse_pose(f"{path}: frame {name}", row) for name, row in zip(names, rows, strict=True)])


@dataclass(frozen=True)
class _Clock:
    """Times of the frames, seconds, how they were obtained, and the files that state them."""

    time: Float[ndarray, " t"]
    assumption: str
    files: tuple[Path, ...] = ()


def _clock(source: Path, names: list[str], options: FramesOptions) -> _Clock:
    if options.timestamps == "name":
        return _Clock(_times_of_names(source, names), "seconds, from the files' names")
    if options.timestamps:
        path = Path(options.timestamps)
        path = path if path.is_file() else member(source, options.timestamps, "--timestamps")
        rows = [numbers(path, line) for line in read_lines(path)]
        if len(rows) != len(names) or any(len(row) != 1 for row in rows):
            raise BadData(
                path, "--timestamps", expected=f"{len(names)} lines of one time each", got=f"{len(rows)} lines"
            )
        return _Clock(np.array(rows, dtype=np.float64)[:, 0], f"seconds, from {path.name}", (path,))
    frame_numbers = [frame_number(name) for name in names]
    known = [number for number in frame_numbers if number is not None]
    if len(known) == len(names) and all(a < b for a, b in pairwise(known)):
        return _Clock(np.array(known, dtype=np.float64) / options.fps, f"frame number / {options.fps:g} per second")
    return _Clock(
        np.arange(len(names)) / options.fps, f"place in the sorted list of frames / {options.fps:g} per second"
    )


def _times_of_names(source: Path, names: list[str]) -> Float[ndarray, " t"]:
    try:
        return np.array([float(name) for name in names])
    except ValueError:
        raise BadData(
            source,
            "--timestamps name",
            expected="* to match a time in seconds",
            got=repr(names[0]),
            fix="change the patterns so that * matches just the time, or pass --fps.",
        ) from None


def _assumptions(options: FramesOptions, clock: str) -> dict[str, str]:
    invalid = f"0 and {options.invalid_depth}" if options.invalid_depth else "0"
    axes = {"opencv": "x right, y down, z forward", "opengl": "x right, y up, z backward; turned to OpenCV's"}
    return {
        "pose": f"files hold {options.pose_is}, metres; quaternions are x y z w",
        "camera axes": f"{options.axes}: {axes[options.axes]}",
        "depth": f"z-depth registered to colour, {options.depth_scale:g} m per unit, {invalid} = no measurement",
        "intrinsics": "pinhole, for colour and depth alike, no lens distortion; pixel (0, 0) is a centre",
        "time": clock,
    }
