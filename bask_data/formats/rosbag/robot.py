"""The robot's states in a bag: the gripper's pose from tf, its width from the positions of joints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from bask_data.errors import BadData
from bask_data.formats.files import listed
from bask_data.formats.options.rosbag import RosbagOptions
from bask_data.formats.recording import RobotRecording
from bask_data.formats.rosbag.bag import Bag
from bask_data.formats.rosbag.contents import Contents, Joints
from bask_data.formats.rosbag.edges import since
from bask_data.formats.rosbag.motion import FrameMotion, gripper_frame

JOINT_GAP = 0.25
"""Longest time between two positions of a joint, seconds, that one is interpolated between: fingers that open in a
second move a quarter of their way. Chosen, sensitivity not measured."""


def robot_states(
    bag: Bag,
    contents: Contents,
    motion: FrameMotion,
    stamps: Sequence[int],
    world_from_gripper: Float[ndarray, "t 4 4"] | None,
    options: RosbagOptions,
) -> tuple[RobotRecording | None, str]:
    """The robot at times in nanoseconds, NaN where unknown, and a statement on it; None if nothing is known of it.

    Args:
        world_from_gripper: if the poses of the camera came from the gripper's.
    """
    parts = []
    if world_from_gripper is not None:
        parts.append(f"world_from_gripper is that of {motion.target}")
    elif name := gripper_frame(motion.tree, options):
        is_guess = not options.gripper_frame
        if not (is_guess and motion.tree.chain(name)[-1] != motion.tree.chain(motion.target)[-1]):
            world_from_gripper = replace(motion, target=name).at(stamps).matrices
            parts.append(
                f"world_from_gripper is that of {name}" + (" (--gripper-frame for another)" if is_guess else "")
            )
    width = None
    if options.gripper_joints:
        width = _width(bag, contents.joints, options.gripper_joints, stamps)
        parts.append(f"the gripper's width is the sum of the positions of {options.gripper_joints}")
    if world_from_gripper is None and width is None:
        return None, ""
    missing = "" if width is not None else "no width (--gripper-joints), "
    return RobotRecording(world_from_gripper, width), f"{'; '.join(parts)}; {missing}no actions"


def _width(bag: Bag, joints: Joints, text: str, stamps: Sequence[int]) -> Float[ndarray, " t"]:
    width = np.zeros(len(stamps))
    for name in (name.strip() for name in text.split(",")):
        if name not in joints.stamps:
            known = listed(sorted(joints.seen), 20) or "none"
            raise BadData(bag.paths[0], "--gripper-joints", expected=f"joints among {known}", got=name)
        sent, first = np.unique(np.array(joints.stamps[name], np.int64), return_index=True)
        start = int(sent[0])
        at, known_at = since(stamps, start), since(sent, start)
        width += np.interp(at, known_at, np.array(joints.positions[name])[first], left=np.nan, right=np.nan)
        after = np.clip(np.searchsorted(known_at, at), 1, max(len(sent) - 1, 1))
        if len(sent) > 1:
            gap = known_at[after] - known_at[after - 1]
            width[(gap > JOINT_GAP) & ~np.isin(at, known_at)] = np.nan
    return width
