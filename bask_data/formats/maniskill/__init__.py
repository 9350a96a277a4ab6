"""Trajectories of ManiSkill 3, and 2: groups `traj_<k>` of an HDF5 file, with a JSON file beside it.

Facts by ManiSkill's `record.py`, `replay_trajectory.py` and its documentation of observations: t observations and t - 1
actions, quaternions w x y z, depth in millimetres (version 2: 1/1024 m), 0 = beyond the far plane.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from bask_data.errors import BadData
from bask_data.formats.choices import chosen_episode
from bask_data.formats.files import Folder
from bask_data.formats.hdf5 import Hdf5File, hdf5_source
from bask_data.formats.json_values import read_json
from bask_data.formats.maniskill.cameras import LAYOUTS, ManiskillCamera, unusable
from bask_data.formats.options.maniskill import ManiskillOptions
from bask_data.formats.poses import parse_transform
from bask_data.formats.recording import RobotRecording, SourceRecording
from bask_data.formats.simulated import about_numbers, chosen_cameras, common_length, left_out, object_labels

FINGERS = (-0.005, 0.045)
"""Range of a Panda's finger joints, metres: 0 to 0.04, and what the simulation overshoots."""

N_PANDA = 9
"""Joints of a Panda with its two fingers, which come last."""

ACTIONS = {"pd_ee_delta_pose": ("dx", "dy", "dz", "drx", "dry", "drz", "gripper")}
"""Names of an action's values by control mode, where they are the same for all robots."""


def read(source: Path, options: ManiskillOptions) -> SourceRecording:
    """The recording of one trajectory."""
    path, file = _opened(source, options)
    name = chosen_episode(source, _trajectories(file), options.episode)
    observations = f"{name}/obs"
    layout = next((layout for layout in LAYOUTS if file.is_group(f"{observations}/{layout.images}")), None)
    if layout is None:
        there = ", ".join(file.members(observations)) if file.is_group(observations) else "no observations"
        raise BadData(
            path,
            observations,
            expected="images, in sensor_data",
            got=there,
            fix="replay it with images: python -m mani_skill.trajectory.replay_trajectory --traj-path FILE "
            "--obs-mode rgbd --save-traj.",
        )
    reasons = unusable(file, observations, layout)
    usable = [camera for camera, reason in reasons.items() if not reason]
    lacking = {camera: reason for camera, reason in reasons.items() if reason}
    names = chosen_cameras(path, options.cameras, usable, lacking)
    document, documents = _document(path, options.follow_links)
    fps, about_time = _rate(document, options.fps)
    objects = object_labels(options.objects)
    cameras = [ManiskillCamera(file, observations, layout, camera) for camera in names]
    read_cameras = [camera.read(fps, objects) for camera in cameras]
    n_frames = common_length(path, {camera.name: len(camera.frames) for camera in read_cameras})
    has_numbers = any(camera.numbers is not None for camera in cameras)
    robot, about_robot = _robot(file, name, n_frames, document)
    return SourceRecording(
        cameras=tuple(read_cameras),
        robot=robot,
        label_names=dict(objects.values()) if has_numbers else {},
        assumptions={
            "pose": "cam2world_gl and extrinsic_cv (camera_from_world), which agree; metres",
            "camera axes": "OpenGL's in cam2world_gl, turned to OpenCV's",
            "depth": f"z-depth, integers of {layout.depth_scale * 1000:.4g} mm, 0 or less = no measurement",
            "intrinsics": cameras[0].about_K,
            "time": about_time,
            "robot": about_robot,
            **({"labels": about_numbers("segmentation", options.objects)} if has_numbers else {}),
            **left_out(lacking, names),
        },
        files=(path, *documents),
    )


def episodes(source: Path, options: ManiskillOptions) -> tuple[str, ...]:
    """Names of the file's trajectories."""
    return tuple(_trajectories(_opened(source, options)[1]))


def _opened(source: Path, options: ManiskillOptions) -> tuple[Path, Hdf5File]:
    path = hdf5_source(source, options.follow_links)
    return path, Hdf5File(path)


def _trajectories(file: Hdf5File) -> list[str]:
    names = [name for name in file.members() if name.startswith("traj_")]
    if not names:
        there = ", ".join(file.members()[:5]) or "nothing"
        raise BadData(file.path, "/", expected="trajectories traj_0, traj_1, ...", got=there, fix="check SOURCE.")
    return names


def _document(path: Path, follow_links: bool) -> tuple[dict[str, Any], tuple[Path, ...]]:
    """The JSON file beside the trajectories, and its path; empty if there is none."""
    folder = Folder(path.parent, follow_links)
    name = f"{path.stem}.json"
    if not folder.has(name):
        return {}, ()
    beside = folder.member(name, "JSON file")
    return read_json(beside), (beside,)


def _inside(document: Any, *keys: str) -> Any:
    for key in keys:
        document = document.get(key) if isinstance(document, dict) else None
    return document


def _rate(document: dict[str, Any], fps: float) -> tuple[float, str]:
    """Frames per second, and a statement on times."""
    stated = _inside(document, "env_info", "env_kwargs", "sim_config", "control_freq")
    if isinstance(stated, int | float) and 0 < stated < 1e4:
        return float(stated), f"frame number / {stated:g} per second, the control frequency in the JSON file"
    return fps, f"frame number / {fps:g} per second: the files state none"


def _robot(file: Hdf5File, name: str, n_frames: int, document: dict[str, Any]) -> tuple[RobotRecording, str]:
    """Gripper, width and action, as far as they are there; and a statement on them."""
    gripper = width = action = names = None
    parts = []
    if file.has(place := f"{name}/obs/extra/tcp_pose"):
        poses = file.array(place, (n_frames, 7)).astype(np.float64)
        gripper = np.stack([parse_transform(f"{file.path}: {place}", list(pose), "wxyz") for pose in poses])
        parts.append("world_from_gripper from tcp_pose (x y z qw qx qy qz)")
    else:
        parts.append("no tcp_pose")
    if file.has(place := f"{name}/obs/agent/qpos"):
        joints = file.array(place, (n_frames, None)).astype(np.float64)
        fingers = joints[:, -2:]
        if joints.shape[1] == N_PANDA and ((FINGERS[0] <= fingers) & (fingers <= FINGERS[1])).all():
            width = fingers.sum(axis=1)
    parts.append("width: sum of the last two joint positions" if width is not None else "no width of a Panda gripper")
    if file.has(place := f"{name}/actions") and not file.is_group(place):
        # The last observation follows the last action, and nothing was commanded at it.
        stored = file.array(place, (n_frames - 1, None)).astype(np.float64)
        action = np.concatenate([stored, stored[-1:]]) if len(stored) else None
        mode = _inside(document, "env_info", "env_kwargs", "control_mode")
        names = ACTIONS.get(mode) if isinstance(mode, str) else None
        names = names if action is not None and names and len(names) == action.shape[1] else None
        about = f"action as stored ({mode})" if isinstance(mode, str) else "action as stored"
        parts.append(f"{about}; the last observation has none: that before it is repeated (--frames :{n_frames - 1})")
    else:
        parts.append("no actions of a single robot")
    return RobotRecording(gripper, width, action, names), "; ".join(parts)
