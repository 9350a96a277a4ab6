"""A folder of colour, depth and pose files: 7-Scenes, 3DMatch, and custom dumps."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from bask_data.core.lens import Lens
from bask_data.errors import BadData
from bask_data.formats.files import Folder, frame_number, numbers, paired, read_lines, source_folder
from bask_data.formats.image_files import ImageFiles
from bask_data.formats.intrinsics import parse_intrinsics
from bask_data.formats.options.frames import FramesOptions
from bask_data.formats.poses import other_readings, parse_transform, read_transforms, to_world_from_camera
from bask_data.formats.recording import RobotRecording, SourceCamera, SourceRecording


def read(source: Path, options: FramesOptions) -> SourceRecording:
    """The recording in `source`; see `FramesOptions` for how the files are interpreted."""
    folder = source_folder(source, options.follow_links)
    groups = {"color": folder.matching(options.color, "color"), "depth": folder.matching(options.depth, "depth")}
    if "*" in options.pose:
        groups["pose"] = folder.matching(options.pose, "pose")
    names, missing = paired(source, groups)
    color, depth = (tuple(groups[kind].get(name, source) for name in names) for kind in ("color", "depth"))
    if "*" in options.pose:
        pose_files = list(groups["pose"].values())
        written = dict(zip(groups["pose"], read_transforms(pose_files, options.quat), strict=True))
        poses = np.stack([written.get(name, np.full((4, 4), np.nan)) for name in names])
        places = tuple(str(groups["pose"].get(name, name)) for name in names)
    else:
        pose_files = [folder.member(options.pose, "--pose")]
        poses = _poses_of_lines(pose_files[0], names, options.quat)
        places = tuple(f"{pose_files[0]}: frame {name}" for name in names)
    K, intrinsics_files = parse_intrinsics(folder, options.intrinsics)
    clock = _clock(folder, names, options)
    images = ImageFiles(color, depth, invalid_depth=_raw_values(options.invalid_depth))
    world_from_cameras, world_from_gripper, hand_eye = to_world_from_camera(poses, options, folder=folder)
    camera = SourceCamera(
        name=options.camera,
        frames=tuple(names),
        lens=Lens(K, images.size),
        world_from_cameras=world_from_cameras,
        time=clock.time,
        color=images.read_color,
        depth=images.read_depth,
        depth_scale=options.depth_scale,
        faults={names.index(name): fault for name, fault in missing.items()},
        pose_places=places,
        intrinsics_size=options.intrinsics_size,
        otherwise=other_readings(poses, options, folder=folder),
    )
    return SourceRecording(
        cameras=(camera,),
        robot=None if world_from_gripper is None else RobotRecording(world_from_gripper),
        label_names={},
        assumptions=_assumptions(options, clock.assumption),
        files=(
            *(file for file in (*color, *depth) if file != source),
            *pose_files,
            *intrinsics_files,
            *clock.files,
            *hand_eye,
        ),
    )


def _raw_values(text: str) -> tuple[int, ...]:
    return tuple(int(word) for word in text.split(",") if word)


def _poses_of_lines(path: Path, names: list[str], quat: str) -> Float[ndarray, "t 4 4"]:
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
    return np.stack(
        [parse_transform(f"{path}: frame {name}", row, quat) for name, row in zip(names, rows, strict=True)]
    )


@dataclass(frozen=True)
class _Clock:
    """Times of the frames, seconds, how they were obtained, and the files that state them."""

    time: Float[ndarray, " t"]
    assumption: str
    files: tuple[Path, ...] = ()


def _clock(folder: Folder, names: list[str], options: FramesOptions) -> _Clock:
    if options.timestamps == "name":
        return _Clock(_times_of_names(folder.path, names), "seconds, from the files' names")
    if options.timestamps:
        path = Path(options.timestamps)
        path = path if path.is_file() else folder.member(options.timestamps, "--timestamps")
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
