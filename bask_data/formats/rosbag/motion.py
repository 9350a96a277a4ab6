"""Where the poses of a bag's cameras come from: tf, or a topic of poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from bask_data.errors import BadData, UsageError
from bask_data.formats.files import listed
from bask_data.formats.options.rosbag import RosbagOptions
from bask_data.formats.rosbag.bag import Bag, frame_name
from bask_data.formats.rosbag.contents import Contents
from bask_data.formats.rosbag.edges import Poses
from bask_data.formats.rosbag.frames import FrameTree
from bask_data.formats.rosbag.pose_topic import POSE_TYPES, with_pose_topic

GRIPPER_FRAMES = (
    "tool0",
    "tcp",
    "gripper_tcp",
    "panda_hand_tcp",
    "panda_hand",
    "fr3_hand_tcp",
    "fr3_hand",
    "hand_tcp",
    "robotiq_85_base_link",
    "ee_link",
    "end_effector_link",
    "gripper_link",
    "link_tcp",
    "tool_frame",
)
"""Names of grippers' frames in usual robot descriptions, the first that is there is taken: Universal Robots, Franka,
Kinova, Fetch, xArm."""

REALSENSE_VIEWER = "/device_"
"""How topics begin that librealsense records, also from RealSense Viewer."""

NO_TF = (
    "record /tf and /tf_static, too, or a topic of poses; or export colour and depth images, whose poses "
    "`bask-data ingest colmap` finds."
)
"""What to do about a bag without any poses."""

NO_POSES = "a recording of RealSense Viewer, which holds no poses"


@dataclass(frozen=True)
class FrameMotion:
    """How to find the pose of a frame in the world.

    Args:
        statement: in words, for the assumptions of a recording.
    """

    tree: FrameTree
    world: str
    target: str
    statement: str

    def at(self, stamps: Sequence[int]) -> Poses:
        """world_from_target at times in nanoseconds."""
        return self.tree.a_from_b(self.world, self.target, stamps)


def camera_motion(bag: Bag, contents: Contents, camera_frame: str, options: RosbagOptions) -> FrameMotion:
    """Where the poses of a camera come from; with `--gripper-from-camera`, those of the gripper that it is on.

    Args:
        camera_frame: its optical frame.

    Raises:
        BadData: tf does not hold the frame, or holds it twice.
        UsageError: an option names a frame that is not there.
    """
    tree, target = contents.tree, camera_frame
    if options.gripper_from_camera and not options.pose_topic:
        target = gripper_frame(tree, options)
        if not target:
            expected = f"the gripper's frame, one of {listed(sorted(tree.frames), 20) or 'none in tf'}"
            raise UsageError("--gripper-frame", expected=expected, got="nothing", fix="pass --gripper-frame FRAME.")
    if options.pose_topic:
        tree, target, world = with_pose_topic(bag, contents, target, options)
        how = options.pose_topic
    else:
        _check_frame(bag, tree, target)
        world = tree.chain(target)[-1]
        how = "tf"
    world = frame_name(options.world) or world
    if world not in tree.frames:
        known = listed(sorted(tree.frames), 20)
        raise UsageError("--world", expected=f"a frame of tf: {known}", got=world, fix="pass one of them.")
    if not options.pose_topic and not options.world:
        _check_moves(bag, tree, world, target)
    chain = tree.chain(target)
    way = " -> ".join(reversed(chain[: chain.index(world) + 1])) if world in chain else f"{world} .. {target}"
    still = "" if tree.moves(world, target) else "; nothing on the way moves"
    return FrameMotion(tree, world, target, f"{how}: {way}, interpolated at the images' times{still}")


def _check_frame(bag: Bag, tree: FrameTree, frame: str) -> None:
    if frame in tree.frames:
        return
    topics = bag.of_type(*POSE_TYPES)
    if not tree.frames:
        fix = f"pass --pose-topic {topics[0]}." if topics else NO_TF
        got = NO_POSES if any(name.startswith(REALSENSE_VIEWER) for name in bag.topics) else "no transforms"
        got += f", but poses in {listed(topics)}" if topics else ""
    else:
        fix = "pass --camera-frame with one of them, or --gripper-frame with --gripper-from-camera FILE."
        got = f"frames {listed(sorted(tree.frames), 20)}"
    raise BadData(
        bag.paths[0], "tf", expected=f"the camera's frame {frame!r}, in which its images are", got=got, fix=fix
    )


def _check_moves(bag: Bag, tree: FrameTree, world: str, target: str) -> None:
    """Refuse a camera that stands still in tf, if its motion may be in another topic."""
    topics = bag.of_type(*POSE_TYPES)
    if topics and not tree.moves(world, target):
        raise BadData(
            bag.paths[0],
            "tf",
            expected=f"transforms that move {target}",
            got=f"static ones only, from {world}; and poses in {listed(topics)}",
            fix=f"pass --pose-topic {topics[0]}, or --world {world} if the camera stands still.",
        )


def gripper_frame(tree: FrameTree, options: RosbagOptions) -> str:
    """The gripper's frame: that of `--gripper-frame`, or one with a usual name, or empty; `UsageError` if it is not in
    tf."""
    if options.gripper_frame:
        name = frame_name(options.gripper_frame)
        if name not in tree.frames:
            known = listed(sorted(tree.frames), 20) or "none"
            raise UsageError("--gripper-frame", expected=f"a frame of tf: {known}", got=name, fix="pass one of them.")
        return name
    return next((name for name in GRIPPER_FRAMES if name in tree.frames), "")
