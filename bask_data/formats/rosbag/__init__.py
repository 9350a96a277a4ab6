"""Bags of ROS 1 and ROS 2: images by topics, joined by the stamps in their headers, with poses from tf.

Facts by the messages' definitions (sensor_msgs, tf2_msgs), REP 103 and 104 on frames and cameras, and the drivers of
RealSense, Azure Kinect, Kinect (OpenNI) and ZED for names of topics.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from bask_data.errors import BadData, UsageError
from bask_data.formats.choices import by_camera
from bask_data.formats.options.rosbag import RosbagOptions
from bask_data.formats.recording import RobotRecording, SourceCamera, SourceRecording
from bask_data.formats.rosbag.bag import Bag
from bask_data.formats.rosbag.camera import BagCamera
from bask_data.formats.rosbag.contents import read_contents
from bask_data.formats.rosbag.robot import robot_states
from bask_data.formats.rosbag.sources import found_bags, opened
from bask_data.formats.rosbag.topics import CameraTopics, chosen_topics

PER_CAMERA = (
    "color_topic",
    "depth_topic",
    "camera_info_topic",
    "depth_info_topic",
    "camera_frame",
    "pose_frame",
    "intrinsics",
    "gripper_from_camera",
)
"""Options that have a value for each of several cameras."""


def read(source: Path, options: RosbagOptions) -> SourceRecording:
    """The images of the cameras in a bag, with the depth nearest in time and the pose at their time; without either,
    they are left out."""
    bag, files = opened(source, options)
    names = options.camera.split(",")
    own = _own_options(names, options)
    topics = [chosen_topics(bag, each.color_topic, each.depth_topic) for each in own]
    _check_distinct(names, topics)
    contents = read_contents(bag, topics, options)
    cameras = [BagCamera(bag, contents, camera, each) for camera, each in zip(topics, own, strict=True)]
    _check_world(bag, names, cameras)
    first = cameras[0]
    ready, files_used, world_from_gripper = first.read(names[0], source, None)
    robot, about_robot = robot_states(bag, contents, first.motion, first.images.stamps, world_from_gripper, options)
    # The states of a robot are those at the images of the first camera: the others take their nearest.
    partners = None if robot is None else first.images
    others = [camera.read(name, source, partners) for name, camera in zip(names[1:], cameras[1:], strict=True)]
    if robot is not None:
        ready = _with_robot_faults(bag, ready, robot)
    assumptions: dict[str, str] = {}
    for name, camera in zip(names, cameras, strict=True):
        prefix = "" if len(names) == 1 else f"{name}: "
        assumptions |= {prefix + key: text for key, text in camera.statements.items()}
    how = "--world" if options.world else "what the poses are in" if options.pose_topic else "the root of its tf tree"
    assumptions["world"] = f"{first.motion.world}, {how}"
    if robot is not None:
        assumptions["robot"] = about_robot
    used = dict.fromkeys((*files, *files_used, *(path for _, paths, _ in others for path in paths)))
    return SourceRecording((ready, *(camera for camera, _, _ in others)), robot, {}, assumptions, tuple(used))


def _own_options(names: list[str], options: RosbagOptions) -> list[RosbagOptions]:
    """The options of each camera."""
    if len(names) == 1:
        return [options]
    values = {name: by_camera(f"--{name.replace('_', '-')}", getattr(options, name), names) for name in PER_CAMERA}
    own = [
        options.model_copy(update={option: found.get(name, "") for option, found in values.items()}) for name in names
    ]
    if options.pose_topic and not all(each.pose_frame for each in own):
        fix = "pass --pose-frame NAME=FRAME;NAME=FRAME with the frame that the poses are of."
        raise UsageError("--pose-frame", expected="a frame for each of several cameras", got="none", fix=fix)
    return own


def _check_distinct(names: list[str], topics: list[CameraTopics]) -> None:
    """Refuse two cameras of the same images."""
    if len({camera.color.name for camera in topics}) < len(topics):
        got = ", ".join(camera.color.name for camera in topics)
        fix = f"pass --color-topic '{names[0]}=TOPIC;{names[1]}=TOPIC', and so for --depth-topic."
        raise UsageError("--color-topic", expected="a topic for each camera", got=got, fix=fix)


def _check_world(bag: Bag, names: list[str], cameras: list[BagCamera]) -> None:
    """Refuse cameras whose poses are in different worlds."""
    worlds = [camera.motion.world for camera in cameras]
    if len(set(worlds)) > 1:
        got = ", ".join(f"{world} of {name}" for name, world in zip(names, worlds, strict=True))
        fix = "record the transform between them, or read each camera by itself."
        raise BadData(bag.paths[0], "tf", expected="all cameras in one tree", got=got, fix=fix)


def episodes(source: Path, options: RosbagOptions) -> tuple[str, ...]:
    """Names of the bags in a folder of several; none with `--split`, which makes them one."""
    return () if options.split else tuple(found_bags(source))


def _with_robot_faults(bag: Bag, camera: SourceCamera, robot: RobotRecording) -> SourceCamera:
    """The camera without the frames at whose time the robot's state is unknown."""
    known = np.ones(len(camera.frames), bool)
    if robot.world_from_gripper is not None:
        known &= np.isfinite(robot.world_from_gripper).all(axis=(1, 2))
    if robot.gripper_width is not None:
        known &= np.isfinite(robot.gripper_width)
    faults, kinds = dict(camera.faults), dict(camera.expected)
    for i in np.flatnonzero(~known).tolist():
        if i not in faults:
            fix = "pass a larger --max-pose-gap, or --skip-bad to leave such frames out."
            expected = "the gripper's pose and width at its time"
            faults[i] = BadData(bag.paths[0], f"frame {i:06d}", expected=expected, got="none", fix=fix)
            kinds[i] = "no robot state"
    return replace(camera, faults=faults, expected=kinds)
