"""Demonstrations saved by RLBench: `<task>/variation<k>/episodes/episode<i>`, with images and `low_dim_obs.pkl`.

The pickle is read without running it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from bask_data.errors import BadData
from bask_data.formats.choices import chosen_episode
from bask_data.formats.files import Folder, listed, natural, source_folder
from bask_data.formats.options.rlbench import RlbenchOptions
from bask_data.formats.pickles import Record, read_pickle
from bask_data.formats.poses import parse_transform
from bask_data.formats.recording import RobotRecording, SourceRecording
from bask_data.formats.rlbench.cameras import PICKLE, found_cameras, numbers_of, read_camera, surplus
from bask_data.formats.simulated import about_numbers, chosen_cameras, left_out, object_labels

CLASSES = ("rlbench.demo.Demo", "rlbench.backend.observation.Observation")

OPEN = "gripper_open"

FULL_WIDTH = 0.08
"""Opening of the open Panda gripper, metres, by its data sheet. RLBench's other grippers have similar ones."""

PLACES = ("", "*/", "episodes/*/", "*/episodes/*/", "*/*/episodes/*/", "*/*/*/episodes/*/")
"""Where episodes may lie in SOURCE: itself, `episodes`, a variation, a task, many tasks, splits of these."""


def read(source: Path, options: RlbenchOptions) -> SourceRecording:
    """The recording of one episode; SOURCE is the episode, or a folder of episodes, variations, tasks."""
    folder = source_folder(source, options.follow_links)
    found = _episodes(folder)
    pickled = folder.member(f"{found[chosen_episode(source, list(found), options.episode)]}/{PICKLE}", "SOURCE")
    episode = Folder(pickled.parent, options.follow_links)
    observations = _observations(pickled)
    images, reasons = found_cameras(episode, observations)
    names = chosen_cameras(episode.path, options.cameras, list(images), reasons)
    objects = object_labels(options.objects)
    read_cameras = [
        read_camera(episode, camera, images[camera], observations, options.fps, objects) for camera in names
    ]
    cameras = tuple(camera for camera, _ in read_cameras)
    has_numbers = any("mask" in images[camera] for camera in names)
    robot, about_robot = _robot(pickled, observations)
    return SourceRecording(
        cameras=cameras,
        robot=robot,
        label_names=dict(objects.values()) if has_numbers else {},
        assumptions={
            "pose": "misc holds world_from_camera, metres",
            "camera axes": "x left, y up, z forward (CoppeliaSim); turned to OpenCV's, and K's focal lengths positive",
            "depth": "24-bit code from the near to the far plane, along z; the far plane = no measurement",
            "intrinsics": read_cameras[0][1],
            "time": f"frame number / {options.fps:g} per second: RLBench states none",
            "robot": about_robot,
            **({"labels": about_numbers("masks", options.objects)} if has_numbers else {}),
            **left_out(reasons, names),
            **surplus(images, len(observations)),
        },
        files=(
            pickled,
            *(file for camera in names for kind in images[camera].values() for file in kind.files.values()),
        ),
    )


def episodes(source: Path, options: RlbenchOptions) -> tuple[str, ...]:
    """Names of the episodes in `source`, such as `variation0/episode3`."""
    return tuple(_episodes(source_folder(source, options.follow_links)))


def _episodes(folder: Folder) -> dict[str, str]:
    """Paths of episodes inside the folder, by their name: the path without the level that is always there."""
    for place in PLACES:
        paths = [path.parent.relative_to(folder.path) for path in folder.path.glob(f"{place}{PICKLE}")]
        named = {
            path.as_posix().replace("episodes/", "") if path.parts else folder.path.resolve().name: path.as_posix()
            for path in paths
            if not any(part.startswith(".") for part in path.parts)
        }
        if named:
            return {name: named[name] for name in sorted(named, key=natural)}
    raise BadData(
        folder.path,
        "SOURCE",
        expected=f"an episode of RLBench, with {PICKLE}",
        got=listed(sorted(path.name for path in folder.path.iterdir())) or "an empty folder",
        fix="pass the folder of an episode, or one above it: TASK/variation0.",
    )


def _observations(path: Path) -> list[dict[str, Any]]:
    """Attributes of each observation."""
    demo = read_pickle(path, CLASSES)
    found = demo.attributes.get("_observations") if isinstance(demo, Record) else demo
    if not isinstance(found, list) or not found or not all(isinstance(item, Record) for item in found):
        raise BadData(path, "_observations", expected="a list of observations", got=f"a {type(found).__name__}")
    return [item.attributes for item in found]


def _robot(where: Path, observations: list[dict[str, Any]]) -> tuple[RobotRecording, str]:
    """Gripper and its width, as far as every observation has them; and a statement on them."""

    def of_all(key: str, shape: tuple[int, ...]) -> ndarray | None:
        if any(observation.get(key) is None for observation in observations):
            return None
        return np.stack([numbers_of(where, i, observation, key, shape) for i, observation in enumerate(observations)])

    poses, joints, is_open = of_all("gripper_pose", (7,)), of_all("gripper_joint_positions", (2,)), of_all(OPEN, ())
    gripper, width, about = None, None, "no width"
    if poses is not None:
        gripper = np.stack([parse_transform(f"{where}: observation {i}", list(pose)) for i, pose in enumerate(poses)])
    if joints is not None:
        width, about = joints.sum(axis=1), "width: sum of the fingers' joint positions, metres"
    if is_open is not None and (width is None or _contradict(is_open, width)):
        why = "" if width is None else ", which the joint positions contradict"
        width, about = is_open * FULL_WIDTH, f"width: {FULL_WIDTH:g} m where gripper_open is 1{why}"
    parts = [
        "no gripper pose" if gripper is None else "world_from_gripper from gripper_pose (x y z qx qy qz qw)",
        about,
        "no actions: RLBench stores states only",
    ]
    return RobotRecording(gripper, width), "; ".join(parts)


def _contradict(is_open: Float[ndarray, " t"], width: Float[ndarray, " t"]) -> bool:
    """Whether the gripper is ever said to be closed at full width: RLBench calls it open from 90 % on."""
    return bool(((is_open == 0) & (width > 0.95 * FULL_WIDTH)).any())
