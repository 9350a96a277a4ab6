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
from bask_data.formats.rosbag_bag import Bag
from bask_data.formats.rosbag_camera import BagCamera
from bask_data.formats.rosbag_contents import read_contents
from bask_data.formats.rosbag_robot import robot_states
from bask_data.formats.rosbag_sources import found_bags, opened
from bask_data.formats.rosbag_topics import CameraTopics, chosen_topics

INFOS = ("camera", "depth")
"""Options `--camera-info-topic` and `--depth-info-topic`, of colour and of depth."""


def read(source: Path, options: RosbagOptions) -> SourceRecording:
    """The images of the cameras in a bag, with the depth nearest in time and the pose at their time; without either,
    they are left out."""
    bag, files = opened(source, options)
    names = options.camera.split(",")
    topics = _topics(bag, names, options)
    contents = read_contents(bag, topics, options)
    infos = [by_camera(f"--{what}-info-topic", getattr(options, f"{what}_info_topic"), names) for what in INFOS]
    cameras = [
        BagCamera(bag, contents, camera, (infos[0].get(name, ""), infos[1].get(name, "")), options)
        for name, camera in zip(names, topics, strict=True)
    ]
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
    assumptions["world"] = f"{first.motion.world}, the root of its tf tree unless --world names another"
    if robot is not None:
        assumptions["robot"] = about_robot
    used = dict.fromkeys((*files, *files_used, *(path for _, paths, _ in others for path in paths)))
    return SourceRecording((ready, *(camera for camera, _, _ in others)), robot, {}, assumptions, tuple(used))


def _topics(bag: Bag, names: list[str], options: RosbagOptions) -> list[CameraTopics]:
    """Topics of each camera's images; `UsageError` if two cameras have the same."""
    color = by_camera("--color-topic", options.color_topic, names)
    depth = by_camera("--depth-topic", options.depth_topic, names)
    topics = [chosen_topics(bag, color.get(name, ""), depth.get(name, "")) for name in names]
    if len({camera.color.name for camera in topics}) < len(topics):
        got = ", ".join(camera.color.name for camera in topics)
        fix = f"pass --color-topic '{names[0]}=TOPIC;{names[1]}=TOPIC', and so for --depth-topic."
        raise UsageError("--color-topic", expected="a topic for each camera", got=got, fix=fix)
    return topics


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
