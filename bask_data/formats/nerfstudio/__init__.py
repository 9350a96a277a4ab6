"""Recordings with transforms.json, as nerfstudio and Instant-NGP read it: images, depth, poses in OpenGL axes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from bask_data.core.geometry import rigid_fault
from bask_data.errors import BadData
from bask_data.formats.clock import seconds
from bask_data.formats.files import Folder, first_readable, natural, source_folder
from bask_data.formats.images import read_color
from bask_data.formats.json_values import array, number, read_json
from bask_data.formats.nerfstudio.depth import DepthFiles
from bask_data.formats.nerfstudio.lens import depth_lens_of, lens_of
from bask_data.formats.options.nerfstudio import NerfstudioOptions
from bask_data.formats.poses import OPENCV_FROM_OPENGL, ROUNDED_TOLERANCE
from bask_data.formats.recording import SourceCamera, SourceRecording

IMAGE_SUFFIXES = ("", ".png", ".jpg", ".jpeg")
"""What is added to a file_path; Blender's scenes leave the suffix out."""

DEPTH_KEYS = ("depth_file_path", "depth_path")
"""Where a frame names its depth, in nerfstudio and in Instant-NGP."""

AXES = {
    "opengl": "opengl: x right, y up, z backward; turned to OpenCV's",
    "opencv": "opencv: x right, y down, z forward",
}
"""What is said of camera axes."""


def read(source: Path, options: NerfstudioOptions) -> SourceRecording:
    """The frames that a file with transforms lists, sorted by their names or their time stamps."""
    folder = source_folder(source, options.follow_links)
    path = _transforms(folder, options.transforms)
    table = read_json(path)
    frames, time, clock = _frames(path, table, options.fps)
    files = [_files(folder, path, frame) for frame in frames]
    faults = {i: file.fault for i, file in enumerate(files) if file.fault}
    color = [file.color for file in files]
    depth = DepthFiles(tuple(file.depth for file in files), _depth_scale(path, table, options.depth_scale))
    usable = [i for i in range(len(frames)) if i not in faults]
    if not usable:
        raise _without_depth(path, frames, faults[0])
    size = first_readable(lambda i: read_color(_there(color[i])), usable).shape[:2]
    lens = lens_of(path, table, frames, size)
    depth_size = first_readable(depth.read, usable).shape[:2]
    poses, world = _poses(path, table, frames, options.world)
    by_axes = {"opengl": poses * np.diag(OPENCV_FROM_OPENGL), "opencv": poses}
    camera = SourceCamera(
        name=options.camera,
        frames=_names(path, frames),
        lens=lens,
        world_from_cameras=by_axes.pop(options.axes),
        time=time,
        color=lambda i: read_color(_there(color[i])),
        depth=depth.read,
        depth_scale=depth.scale,
        depth_lens=None if depth_size == lens.size else depth_lens_of(lens, depth_size),
        faults=faults,
        otherwise={f"--axes {axes}": other for axes, other in by_axes.items()},
        pose_places=tuple(f"{path}: transform_matrix of {frame['file_path']}" for frame in frames),
    )
    per_frame = "differs from frame to frame" if lens.K.ndim == 3 else "one for all frames"
    assumptions = {
        "pose": "transform_matrix holds world_from_camera, taken to be in metres as depth is; the file does not say so",
        "camera axes": AXES[options.axes],
        "world": world,
        "depth": f"z-depth, {depth.scale:g} m per unit, 0 = no measurement",
        "intrinsics": f"pinhole with pixel (0, 0) as a centre: 0.5 is subtracted from cx and cy; {per_frame}",
        "time": clock,
    }
    if any("mask_path" in frame for frame in frames):
        assumptions["masks"] = "mask_path is not read; pass --labels for ground truth"
    used = (*color, *depth.files)
    return SourceRecording((camera,), None, {}, assumptions, (path, *(file for file in used if file)))


def _transforms(folder: Folder, name: str) -> Path:
    others = sorted(file.name for file in folder.path.glob("transforms*.json"))
    if not folder.has(name) and others:
        fix = f"pass --transforms {others[0]}."
        raise BadData(folder.path / name, "--transforms", expected="a file", got="no such path", fix=fix)
    return folder.member(name, "--transforms")


def _frames(path: Path, table: Mapping[str, Any], fps: float) -> tuple[list[dict[str, Any]], Float[ndarray, " t"], str]:
    """The frames in order, their times in seconds, and how these were obtained."""
    frames = table.get("frames")
    if not isinstance(frames, list) or not frames:
        raise BadData(path, "frames", expected="a list of frames", got=repr(frames)[:80])
    for i, frame in enumerate(frames):
        if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str) or not frame["file_path"]:
            raise BadData(path, f"frames[{i}]", expected="an object with file_path", got=repr(frame)[:80])
    if all("timestamp" in frame for frame in frames):
        stamps = [number(f"{path}: {frame['file_path']}", frame, "timestamp") for frame in frames]
        order = np.argsort(stamps, kind="stable")
        clock = seconds(np.array(stamps)[order], path, instead="remove timestamp from all frames", option="")
        return [frames[i] for i in order], clock.time, clock.statement
    frames = sorted(frames, key=lambda frame: natural(frame["file_path"]))
    statement = f"place in the sorted list of frames / {fps:g} per second: the file has no times"
    return frames, np.arange(len(frames)) / fps, statement


@dataclass(frozen=True)
class _FrameFiles:
    """The files of a frame, or why they cannot be used."""

    color: Path | None
    depth: Path | None
    fault: BadData | None


def _files(folder: Folder, path: Path, frame: Mapping[str, Any]) -> _FrameFiles:
    name = frame["file_path"]
    color = _found(folder, name, "file_path", IMAGE_SUFFIXES)
    stated = next((frame[key] for key in DEPTH_KEYS if frame.get(key)), None)
    if stated is None:
        fault = BadData(
            path,
            f"depth_file_path of {name}",
            expected="a depth file for every frame",
            got="none",
            fix="pass --skip-bad to leave out the frames without depth.",
        )
        return _FrameFiles(color, None, fault)
    depth = _found(folder, str(stated), "depth_file_path", ("", ".png", ".npy"))
    for file, field, stem in ((color, "file_path", name), (depth, "depth_file_path", stated)):
        if file is None:
            fix = "check SOURCE, or pass --skip-bad to leave out the frames without their files."
            fault = BadData(folder.path / str(stem), field, expected="a file", got="no such path", fix=fix)
            return _FrameFiles(color, depth, fault)
    return _FrameFiles(color, depth, None)


def _found(folder: Folder, stated: str, field: str, suffixes: Sequence[str]) -> Path | None:
    """The file at a path as the transforms state it; None if there is none. `BadData` if it leads out of the folder."""
    relative = stated.replace("\\", "/")
    for suffix in suffixes:
        if folder.has(relative + suffix) and not (folder.path / (relative + suffix)).is_dir():
            return folder.member(relative + suffix, field)
    # Paths that lead out are refused, whether or not there is anything.
    if relative.startswith("/") or ".." in relative.split("/"):
        return folder.member(relative, field)
    return None


def _there(path: Path | None) -> Path:
    assert path is not None  # Frames without their files are among the faults, and never read.
    return path


def _names(path: Path, frames: Sequence[Mapping[str, Any]]) -> tuple[str, ...]:
    """The files' names without suffix, or their paths where these repeat."""
    stated = [frame["file_path"] for frame in frames]
    if len(set(stated)) < len(stated):
        twice = next(name for name in stated if stated.count(name) > 1)
        raise BadData(path, "file_path", expected="another image for each frame", got=f"{twice} twice")
    stems = [Path(name.replace("\\", "/")).stem for name in stated]
    return tuple(stems if len(set(stems)) == len(stems) else stated)


def _depth_scale(path: Path, table: Mapping[str, Any], chosen: float | None) -> float:
    from_file = number(path, table, "integer_depth_scale", 0.0)
    return chosen or (from_file if from_file > 0 else 0.001)


def _without_depth(path: Path, frames: Sequence[Mapping[str, Any]], fault: BadData) -> BadData:
    """The error of a file none of whose frames can be used."""
    if any(frame.get(key) for frame in frames for key in DEPTH_KEYS):
        return fault
    return BadData(
        path,
        "depth_file_path",
        expected="depth for the frames: a recording of colour and poses alone has no surface",
        got=f"none in {len(frames)} frames",
        fix="state depth_file_path in each frame; depth of Polycam and Record3D is read by `ingest polycam` and "
        "`ingest record3d` from their own exports.",
    )


def _poses(
    path: Path, table: Mapping[str, Any], frames: Sequence[Mapping[str, Any]], world: str
) -> tuple[Float[ndarray, "t 4 4"], str]:
    """world_from_camera in OpenGL axes, and which world it is."""
    poses = np.tile(np.eye(4), (len(frames), 1, 1))
    for pose, frame in zip(poses, frames, strict=True):
        place = f"transform_matrix of {frame['file_path']}"
        matrix = array(path, place, frame.get("transform_matrix"), ((4, 4), (3, 4)))
        pose[: len(matrix)] = matrix
    if "applied_transform" not in table and "applied_scale" not in table:
        return poses, "as in the file, which states no transform that was applied to it"
    if world == "file":
        return poses, "as in the file: applied_transform and applied_scale are not undone (--world file)"
    file_from_source = np.eye(4)
    if "applied_transform" in table:
        applied = array(path, "applied_transform", table["applied_transform"], ((3, 4), (4, 4)))
        file_from_source[: len(applied)] = applied
    scale = number(path, table, "applied_scale", 1.0)
    fault = "" if scale > 0 else f"scale {scale:g}"
    if fault := fault or rigid_fault(file_from_source, ROUNDED_TOLERANCE):
        fix = "pass --world file to leave the world as it is."
        raise BadData(path, "applied_transform", expected="a rotation, a translation and a scale", got=fault, fix=fix)
    # nerfstudio scales what the transform gave.
    poses[:, :3, 3] /= scale
    unscaled = f" and applied_scale {scale:g}" if scale != 1 else ""
    return (
        np.linalg.inv(file_from_source) @ poses,
        f"the source's: applied_transform{unscaled} of the file is undone, so axes are those before ns-process-data",
    )
