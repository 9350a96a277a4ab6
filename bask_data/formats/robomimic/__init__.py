"""Demonstrations in robomimic's HDF5 files, with images, depth and `camera_info`; also those that `export` writes.

Facts by robomimic's `dataset_states_to_obs.py` and `env_robosuite.py`: images are stored the right way up, the first
observation is of the first state, and there are as many actions as observations.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from bask_data.errors import BadData
from bask_data.formats.choices import chosen_episode
from bask_data.formats.hdf5 import Hdf5File, hdf5_source
from bask_data.formats.json_values import parse_json
from bask_data.formats.options.robomimic import RobomimicOptions
from bask_data.formats.recording import RobotRecording, SourceRecording
from bask_data.formats.robomimic.cameras import RobomimicCamera, hand_poses, unusable
from bask_data.formats.simulated import chosen_cameras, common_length, left_out

N_FINGERS = 2
"""Joints of a parallel gripper, whose positions have opposite signs in robosuite; their distance is its opening."""


def read(source: Path, options: RobomimicOptions) -> SourceRecording:
    """The recording of one demonstration."""
    path, file = _opened(source, options)
    demo = f"data/{chosen_episode(source, _demonstrations(file), options.episode)}"
    info = _camera_info(file, demo)
    reasons = unusable(file, demo, info, options)
    usable = [camera for camera, reason in reasons.items() if not reason]
    lacking = {camera: reason for camera, reason in reasons.items() if reason}
    names = chosen_cameras(path, options.cameras, usable, lacking)
    cameras = [RobomimicCamera(file, demo, name, info.get(name, {}), options) for name in names]
    n_frames = common_length(path, {camera.name: camera.n_frames for camera in cameras})
    time, about_time = _time(file, demo, n_frames, options.fps)
    robot, about_robot = _robot(file, demo, n_frames, options)
    read_cameras = tuple(camera.read(time) for camera in cameras)
    about_poses = list(dict.fromkeys(camera.about_poses for camera in cameras))
    return SourceRecording(
        cameras=read_cameras,
        robot=robot,
        label_names={},
        assumptions={
            "pose": "; ".join(about_poses),
            "camera axes": "opencv: x right, y down, z forward",
            "depth": cameras[0].about_depth,
            "intrinsics": cameras[0].about_K,
            "time": about_time,
            "robot": about_robot,
            **left_out(lacking, names),
        },
        files=(path,),
    )


def episodes(source: Path, options: RobomimicOptions) -> tuple[str, ...]:
    """Names of the file's demonstrations."""
    return tuple(_demonstrations(_opened(source, options)[1]))


def _opened(source: Path, options: RobomimicOptions) -> tuple[Path, Hdf5File]:
    path = hdf5_source(source, options.follow_links)
    return path, Hdf5File(path)


def _demonstrations(file: Hdf5File) -> list[str]:
    names = [name for name in file.members("data") if file.is_group(f"data/{name}")]
    if not names:
        raise BadData(file.path, "data", expected="demonstrations demo_0, demo_1, ...", got="none", fix="check SOURCE.")
    return names


def _document(file: Hdf5File, place: str, name: str) -> dict[str, Any]:
    """A JSON attribute; empty if there is none."""
    text = file.attribute(place, name)
    if not isinstance(text, str):
        return {}
    return parse_json(f"{file.path}: {place} attribute {name}", text.encode("utf-8", "replace"))


def _camera_info(file: Hdf5File, demo: str) -> dict[str, Any]:
    return _document(file, demo, "camera_info") or _document(file, "data", "camera_info")


def _time(file: Hdf5File, demo: str, n_frames: int, fps: float) -> tuple[Float[ndarray, " t"], str]:
    """Seconds of each frame, and a statement on them."""
    if file.has(place := f"{demo}/time"):
        return file.array(place, (n_frames,)).astype(np.float64), "seconds, as recorded"
    arguments = _document(file, "data", "env_args").get("env_kwargs")
    stated = arguments.get("control_freq") if isinstance(arguments, dict) else None
    if isinstance(stated, int | float) and 0 < stated < 1e4:
        return np.arange(n_frames) / stated, f"frame number / {stated:g} per second, the control frequency in env_args"
    return np.arange(n_frames) / fps, f"frame number / {fps:g} per second: the file states none"


def _robot(file: Hdf5File, demo: str, n_frames: int, options: RobomimicOptions) -> tuple[RobotRecording, str]:
    """Gripper, width and action, as far as they are there; and a statement on them."""
    if file.is_group(recorded := f"{demo}/recorded"):
        return _exported_robot(file, recorded, n_frames), "as it was exported"
    gripper, about = hand_poses(file, demo, "robot0_", n_frames, options)
    parts = [about]
    width = action = None
    if file.has(place := f"{demo}/obs/robot0_gripper_qpos") and file.shape(place)[1:] == (N_FINGERS,):
        width = np.abs(np.diff(file.array(place, (n_frames, N_FINGERS)).astype(np.float64), axis=1))[:, 0]
    parts.append(
        "no width of a parallel gripper" if width is None else "width: distance of the fingers in gripper_qpos"
    )
    if file.has(place := f"{demo}/actions"):
        action = file.array(place, (n_frames, None)).astype(np.float64)
    parts.append("no actions" if action is None else "actions as stored")
    if any(name.startswith("robot1_") for name in file.members(f"{demo}/obs")):
        parts.append("states of the first of several robots only")
    return RobotRecording(gripper, width, action), "; ".join(parts)


def _exported_robot(file: Hdf5File, recorded: str, n_frames: int) -> RobotRecording:
    """The robot as `export robomimic --cameras` writes it."""
    there = file.members(recorded)
    names = file.attribute(recorded, "action_names")
    return RobotRecording(
        world_from_gripper=file.array(f"{recorded}/world_from_gripper", (n_frames, 4, 4))
        if "world_from_gripper" in there
        else None,
        gripper_width=file.array(f"{recorded}/gripper_width", (n_frames,)) if "gripper_width" in there else None,
        action=file.array(f"{recorded}/action", (n_frames, None)) if "action" in there else None,
        action_names=_names(f"{file.path}: {recorded}", names) if isinstance(names, str) else None,
    )


def _names(where: str, text: str) -> tuple[str, ...]:
    """Names in a JSON list."""
    try:
        found = json.loads(text)
    except (ValueError, RecursionError):
        found = None
    if not isinstance(found, list) or not all(isinstance(name, str) for name in found):
        raise BadData(where, "action_names", expected="a JSON list of names", got=text[:80])
    return tuple(found)
