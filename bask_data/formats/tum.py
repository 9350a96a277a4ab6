"""Sequences in the layout of the TUM RGB-D benchmark: text lists of timestamped files, joined by time."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from bask_data.core.lens import Lens
from bask_data.core.time_pairs import mutual_nearest
from bask_data.errors import BadData
from bask_data.formats.clock import Clock, seconds
from bask_data.formats.files import Folder, listed, numbered_lines, source_folder
from bask_data.formats.frames.poses import poses_at_times
from bask_data.formats.image_files import ImageFiles
from bask_data.formats.images import image_header
from bask_data.formats.intrinsics import read_calibration, refuse_unnamed_lens
from bask_data.formats.options.tum import TumOptions
from bask_data.formats.poses import other_readings, to_world_from_camera
from bask_data.formats.recording import RobotRecording, SourceCamera, SourceRecording
from bask_data.formats.trajectory_files import PoseLayout, Trajectory, read_trajectory, stamps_of

INTRINSICS = {
    "freiburg1": "517.3,516.5,318.6,255.3",
    "freiburg2": "520.9,521.0,325.1,249.7",
    "freiburg3": "535.4,539.2,320.1,247.6",
}
"""The benchmark's published intrinsics fx, fy, cx, cy, pixels, of the colour cameras of its three rigs."""

TRAJECTORIES = ("CameraTrajectory.txt", "KeyFrameTrajectory.txt", "trajectory.txt", "poses.txt", "groundtruth.csv")
"""Names of what SLAM systems write, which an error offers; the first two are ORB-SLAM's."""

ASSOCIATIONS = ("associations.txt", "associated.txt", "association.txt", "assoc.txt")
"""Usual names of files that pair colour and depth, which an error offers."""


def read(source: Path, options: TumOptions) -> SourceRecording:
    """The colour images in `source`, with the depth nearest in time and the pose at their time; without either, they
    are left out."""
    folder = source_folder(source, options.follow_links)
    images = _images(folder, options)
    trajectory = _trajectory(folder, options)
    poses = poses_at_times(trajectory, list(images.names), images.time, options.time_unit, options.max_pose_gap)
    without_depth = [int(i) for i in np.flatnonzero(images.depth_of < 0)]
    expected = {**poses.faults, **{i: _no_depth(folder, images, i, options) for i in without_depth}}
    if len(expected) == len(images.names):
        raise BadData(
            source,
            "timestamps",
            expected=f"colour and depth within {options.max_time_difference:g} s, and poses around them",
            got=f"none of {len(images.names)} colour images",
            fix="check that the clocks agree, or pass a larger --max-time-difference or --max-pose-gap.",
        )
    calibration = read_calibration(folder, INTRINSICS.get(options.intrinsics, options.intrinsics))
    refuse_unnamed_lens(calibration, options.distortion)
    world_from_cameras, world_from_gripper, hand_eye = to_world_from_camera(
        poses.at(poses.written, options), options, folder=folder
    )
    camera = SourceCamera(
        name=options.camera,
        frames=images.names,
        lens=Lens(calibration.K, images.files.size, calibration.distortion),
        world_from_cameras=world_from_cameras,
        time=images.time,
        color=images.files.read_color,
        depth=images.files.read_depth,
        depth_scale=options.depth_scale,
        faults={**images.faults, **expected},
        expected={i: "no depth" if images.depth_of[i] < 0 else "no pose" for i in expected},
        pose_places=poses.places,
        intrinsics_size=options.intrinsics_size or calibration.size,
        otherwise=other_readings(poses.written, options, folder=folder, quaternions=True, at=poses.at),
    )
    return SourceRecording(
        cameras=(camera,),
        robot=None if world_from_gripper is None else RobotRecording(world_from_gripper),
        label_names={},
        assumptions={
            "pose": f"{trajectory.path.name} holds {options.pose_is} of the colour camera, quaternions are "
            f"{' '.join(options.quat)}; {poses.statement}",
            "camera axes": options.axes,
            "depth": f"z-depth registered to colour, {options.depth_scale:g} m per unit, 0 = no measurement; the image "
            f"nearest in time, at most {options.max_time_difference:g} s away",
            "intrinsics": f"{options.intrinsics}: {calibration.statement_with(options.distortion)}",
            "time": images.clock.statement,
        },
        files=(*images.lists, *poses.files, *calibration.files, *hand_eye, *images.files.files),
    )


@dataclass(frozen=True)
class _Images:
    """The colour images of a sequence, and the depth of each.

    Args:
        names: of the colour files, as listed.
        clock: times of colour.
        depth_of: index of the depth image of each; negative if there is none.
        lists: the files that list them.
        faults: images that are listed and not there, by index.
    """

    names: tuple[str, ...]
    clock: Clock
    depth_of: Int[ndarray, " n"]
    files: ImageFiles
    lists: tuple[Path, ...]
    faults: dict[int, BadData]

    @property
    def time(self) -> Float[ndarray, " n"]:
        """Seconds."""
        return self.clock.time


def _images(folder: Folder, options: TumOptions) -> _Images:
    if options.associations:
        return _associated(folder, options)
    (color_path, color_clock, color), (depth_path, depth_clock, depth) = (
        _file_list(folder, name, options) for name in ("rgb.txt", "depth.txt")
    )
    depth_of = mutual_nearest(color_clock.time, depth_clock.time, options.max_time_difference)
    files, faults = _found(folder, color, [depth[k] if k >= 0 else None for k in depth_of])
    return _Images(tuple(color), color_clock, depth_of, files, (color_path, depth_path), faults)


def _found(folder: Folder, color: list[str], depth: list[str | None]) -> tuple[ImageFiles, dict[int, BadData]]:
    """The files of colour and depth, and by index the faults of those that are not there."""
    faults: dict[int, BadData] = {}
    found: dict[str, list[Path | None]] = {"colour": [], "depth": []}
    for i, names in enumerate(zip(color, depth, strict=True)):
        for kind, name in zip(found, names, strict=True):
            try:
                found[kind].append(None if name is None else folder.member(name, kind))
            except BadData as error:
                found[kind].append(None)
                faults[i] = error
    if faults and not any(found["colour"]):
        raise faults[0]
    return ImageFiles(tuple(found["colour"]), tuple(found["depth"])), faults


def _associated(folder: Folder, options: TumOptions) -> _Images:
    """Colour and depth paired by a file `time file time file`; the one of 16 bits is depth."""
    path = folder.member(options.associations, "--associations")
    lines, words = _rows(
        path, "time file time file", "leave out --associations: rgb.txt and depth.txt are then joined by time."
    )
    depth_at = 0 if image_header(folder.member(words[0][1], path.name)).bits == 16 else 2
    clock = _clock(path, [row[2 - depth_at] for row in words], lines, options)
    names = [row[3 - depth_at] for row in words]
    files, faults = _found(folder, names, [row[1 + depth_at] for row in words])
    return _Images(tuple(names), clock, np.arange(len(names)), files, (path,), faults)


def _file_list(folder: Folder, name: str, options: TumOptions) -> tuple[Path, Clock, list[str]]:
    others = [other for other in ASSOCIATIONS if folder.has(other)]
    if not folder.has(name):
        fix = (
            f"pass --associations {others[0]}." if others else "check SOURCE; other folders are read by ingest frames."
        )
        raise BadData(folder.path / name, "images", expected="a file of `timestamp file`", got="no such path", fix=fix)
    path = folder.member(name, name)
    lines, words = _rows(
        path, "timestamp file", "correct the file; a file that lists both is read by --associations FILE.", maxsplit=1
    )
    return path, _clock(path, [row[0] for row in words], lines, options), [row[1] for row in words]


def _rows(path: Path, form: str, fix: str, maxsplit: int = -1) -> tuple[list[int], list[list[str]]]:
    """Numbers and words of the lines of a file, each of which has the form; `BadData` otherwise."""
    lines = numbered_lines(path)
    words = [line.split(maxsplit=maxsplit) for _, line in lines]
    n = len(form.split())
    if not words or any(len(row) != n for row in words):
        odd = next((i for (i, _), row in zip(lines, words, strict=True) if len(row) != n), 0)
        got = f"another in line {odd}" if odd else "none"
        raise BadData(path, "lines", expected=f"`{form}` in each", got=got, fix=fix)
    return [i for i, _ in lines], words


def _clock(path: Path, words: list[str], lines: list[int], options: TumOptions) -> Clock:
    try:
        stamps = stamps_of(words)
    except ValueError as error:
        raise BadData(
            path, "lines", expected="times that are numbers", got=str(error)[:100], fix="correct the file."
        ) from error
    return seconds(stamps, path, lines, unit=options.time_unit)


def _trajectory(folder: Folder, options: TumOptions) -> Trajectory:
    if not folder.has(options.trajectory):
        others = [name for name in TRAJECTORIES if folder.has(name)]
        raise BadData(
            folder.path / options.trajectory,
            "poses",
            expected="a file of lines `timestamp tx ty tz qx qy qz qw`",
            got="no such path",
            fix=f"pass --trajectory {others[0] if others else 'FILE'}.",
        )
    trajectory = read_trajectory(folder.member(options.trajectory, "--trajectory"), PoseLayout(options.quat))
    if not trajectory.keys or not trajectory.quaternions:
        raise BadData(
            trajectory.path,
            "lines",
            expected="`timestamp tx ty tz qx qy qz qw` in each",
            got="poses without times" if not trajectory.keys else "matrices",
            fix="pass --trajectory with a file of such lines; poses without times are read by `ingest frames`.",
        )
    return trajectory


def _no_depth(folder: Folder, images: _Images, i: int, options: TumOptions) -> BadData:
    without = [images.names[k] for k in np.flatnonzero(images.depth_of < 0)]
    return BadData(
        folder.path,
        images.names[i],
        expected=f"a depth image of its own within {options.max_time_difference:g} s",
        got=f"none, as for {listed(without)}",
        fix="pass a larger --max-time-difference, or --skip-bad to leave such frames out.",
    )
