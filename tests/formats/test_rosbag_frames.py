from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bask_data.errors import BadData, UsageError
from bask_data.formats import rosbag
from bask_data.formats.options.rosbag import RosbagOptions
from bask_data.formats.recording import SourceRecording
from tests.formats.bags import (
    COLOR,
    DEPTH,
    OPTICAL,
    STAMPS,
    START,
    TOOL_FROM_CAMERA,
    WORLD_FROM_CAMERAS,
    WORLD_FROM_TOOLS,
    BagWriter,
    write_images,
    write_tf,
)
from tests.formats.folders import rigid


def recording_of(
    path: Path, write: Callable[[BagWriter], None], kind: str = "mcap", **options: object
) -> SourceRecording:
    """A bag with four images, and transforms or poses that a function writes."""
    bag = BagWriter(path, kind)
    write(bag)
    write_images(bag)
    return rosbag.read(bag.close(), RosbagOptions(**options))


def poses_of(recording: SourceRecording) -> np.ndarray:
    return recording.cameras[0].world_from_cameras


def test_tf1_frames_begin_with_a_slash_and_static_ones_are_sent_again(tmp_path: Path) -> None:
    def write(bag: BagWriter) -> None:
        for i in range(-1, 9):
            stamp = START + i * 50_000_000
            parts = (stamp, "/tool0", f"/{OPTICAL}", TOOL_FROM_CAMERA)
            bag.write("/tf", stamp, bag.transforms(parts, type="tf/msg/tfMessage"))
        for stamp, pose in zip(STAMPS, WORLD_FROM_TOOLS, strict=True):
            bag.write("/tf", stamp, bag.transforms((stamp, "/base", "/tool0", pose), type="tf/msg/tfMessage"))

    recording = recording_of(tmp_path / "scan", write, "bag")
    assert np.abs(poses_of(recording) - WORLD_FROM_CAMERAS).max() < 1e-12
    assert recording.assumptions["world"].startswith("base, ")


def test_the_world_is_the_root_and_any_frame_of_the_tree_by_option(tmp_path: Path) -> None:
    map_from_base, base_from_marker = rigid(np.random.default_rng(1)), rigid(np.random.default_rng(2))

    def write(bag: BagWriter) -> None:
        write_tf(bag)
        parts = [(0, "map", "base", map_from_base), (0, "base", "marker", base_from_marker)]
        bag.write("/tf_static", START, bag.transforms(*parts))

    for world, world_from_base in (
        ("", map_from_base),
        ("base", np.eye(4)),
        ("/marker", np.linalg.inv(base_from_marker)),
    ):
        recording = recording_of(tmp_path / f"scan{world.strip('/')}", write, world=world)
        assert np.abs(poses_of(recording) - world_from_base @ WORLD_FROM_CAMERAS).max() < 1e-9


def test_the_last_of_several_static_transforms_holds_and_the_first_of_repeated_ones(tmp_path: Path) -> None:
    def write(bag: BagWriter) -> None:
        wrong = rigid(np.random.default_rng(3))
        bag.write("/tf_static", START, bag.transforms((0, "tool0", "camera_link", wrong)))
        write_tf(bag)
        for stamp in STAMPS:
            bag.write("/tf", stamp + 1, bag.transforms((stamp, "base", "tool0", wrong)))

    assert np.abs(poses_of(recording_of(tmp_path / "scan", write)) - WORLD_FROM_CAMERAS).max() < 1e-12


def test_two_parents_and_circles_are_refused_and_can_be_ignored(tmp_path: Path) -> None:
    def two_parents(bag: BagWriter) -> None:
        write_tf(bag)
        bag.write("/tf_static", START, bag.transforms((0, "other", "camera_link", np.eye(4))))

    with pytest.raises(BadData, match="tf: camera_link: expected one parent, got other and tool0"):
        recording_of(tmp_path / "two", two_parents)
    read = recording_of(tmp_path / "ignored", two_parents, ignore_tf="other:camera_link")
    assert np.abs(poses_of(read) - WORLD_FROM_CAMERAS).max() < 1e-12
    with pytest.raises(UsageError, match="--ignore-tf: expected PARENT:CHILD among"):
        recording_of(tmp_path / "unknown", two_parents, ignore_tf="tool0:nobody")

    def circle(bag: BagWriter) -> None:
        write_tf(bag)
        bag.write("/tf_static", START, bag.transforms((0, OPTICAL, "base", np.eye(4))))

    with pytest.raises(
        BadData, match=f"expected a tree, got a circle: {OPTICAL} -> camera_link -> tool0 -> base -> {OPTICAL}"
    ):
        recording_of(tmp_path / "circle", circle)


def test_rotations_that_are_none_are_refused_by_their_frame(tmp_path: Path) -> None:
    def write(bag: BagWriter) -> None:
        write_tf(bag)
        transforms = bag.transforms((0, "tool0", "camera_link", np.eye(4)))
        transforms.transforms[0].transform.rotation.w = 0.0
        bag.write("/tf_static", START, transforms)

    with pytest.raises(BadData, match="tf: camera_link: rotation: expected a quaternion of length 1"):
        recording_of(tmp_path / "scan", write)


def test_transforms_of_another_time_are_refused_with_both_times(tmp_path: Path) -> None:
    def write(bag: BagWriter) -> None:
        write_tf(bag, [stamp - 10**12 for stamp in STAMPS])

    with pytest.raises(BadData, match=r"none for 4 images from 1700000000.123 to .*tf base -> tool0 1699999000.123"):
        recording_of(tmp_path / "scan", write)


def poses_on(bag: BagWriter, type: str, matrices: np.ndarray, frame: str = "map", child: str = "") -> None:
    """Messages of poses on /pose."""
    package = "nav_msgs" if type in ("Odometry", "Path") else "geometry_msgs"
    made: list[Any] = []
    for stamp, matrix in zip(STAMPS, matrices, strict=True):
        header, pose = bag.header(stamp, frame), bag.pose(matrix)
        covariance = np.zeros(36)
        if type == "TransformStamped":
            made.append(bag.transform(stamp, frame, child, matrix))
            continue
        if type in ("PoseWithCovarianceStamped", "Odometry"):
            pose = bag.make("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=covariance)
        fields: dict[str, Any] = {"header": header, "pose": pose}
        if type == "Odometry":
            zero = bag.make("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
            twist = bag.make("geometry_msgs/msg/Twist", linear=zero, angular=zero)
            twist = bag.make("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=covariance)
            fields |= {"child_frame_id": child, "twist": twist}
        kind = "geometry_msgs/msg/PoseStamped" if type == "Path" else f"{package}/msg/{type}"
        made.append(bag.make(kind, **fields))
    if type == "Path":
        # A path that grows: only the last message is whole.
        made = [
            bag.make("nav_msgs/msg/Path", header=bag.header(s, frame), poses=made[: i + 1])
            for i, s in enumerate(STAMPS)
        ]
    for stamp, message in zip(STAMPS, made, strict=True):
        bag.write("/pose", stamp, message)


@pytest.mark.parametrize("type", ["PoseStamped", "PoseWithCovarianceStamped", "Path"])
def test_poses_of_a_topic_are_the_cameras(tmp_path: Path, type: str) -> None:
    recording = recording_of(
        tmp_path / "scan", lambda bag: poses_on(bag, type, WORLD_FROM_CAMERAS), "bag", pose_topic="/pose"
    )
    assert np.abs(poses_of(recording) - WORLD_FROM_CAMERAS).max() < 1e-12
    assert recording.assumptions["pose"].startswith(f"/pose: map -> {OPTICAL}")


@pytest.mark.parametrize("type", ["Odometry", "TransformStamped"])
def test_poses_of_a_frame_are_led_to_the_camera_by_tf(tmp_path: Path, type: str) -> None:
    def write(bag: BagWriter) -> None:
        # tf has another idea of where the tool is, which a topic of poses takes the place of.
        write_tf(bag, poses=list(WORLD_FROM_TOOLS[::-1]))
        poses_on(bag, type, WORLD_FROM_TOOLS, child="tool0")

    recording = recording_of(tmp_path / "scan", write, pose_topic="/pose")
    assert np.abs(poses_of(recording) - WORLD_FROM_CAMERAS).max() < 1e-12


def test_poses_of_a_frame_that_tf_does_not_know_are_refused_with_what_helps(tmp_path: Path) -> None:
    def write(bag: BagWriter) -> None:
        poses_on(bag, "Odometry", WORLD_FROM_TOOLS, child="body")

    with pytest.raises(
        BadData, match=f"expected tf between body and the camera's frame {OPTICAL}.*--pose-frame {OPTICAL}"
    ):
        recording_of(tmp_path / "scan", write, pose_topic="/pose")
    own = recording_of(tmp_path / "own", write, pose_topic="/pose", pose_frame=OPTICAL)
    assert np.abs(poses_of(own) - WORLD_FROM_TOOLS).max() < 1e-12
    hand_eye = tmp_path / "body_from_camera.txt"
    np.savetxt(hand_eye, TOOL_FROM_CAMERA)
    led = recording_of(tmp_path / "led", write, pose_topic="/pose", gripper_from_camera=str(hand_eye))
    assert np.abs(poses_of(led) - WORLD_FROM_CAMERAS).max() < 1e-9
    with pytest.raises(
        BadData, match="--pose-topic /poses: expected a topic of PoseStamped.*there are: /pose, got no such topic"
    ):
        recording_of(tmp_path / "none", write, pose_topic="/poses")


def test_a_camera_that_only_another_topic_moves_is_refused(tmp_path: Path) -> None:
    def write(bag: BagWriter) -> None:
        bag.write("/tf_static", START, bag.transforms((0, "camera_link", OPTICAL, TOOL_FROM_CAMERA)))
        poses_on(bag, "PoseStamped", WORLD_FROM_TOOLS)

    with pytest.raises(BadData, match="got static ones only, from camera_link; and poses in /pose.*--pose-topic /pose"):
        recording_of(tmp_path / "scan", write)
    still = recording_of(tmp_path / "still", write, world="camera_link")
    assert np.abs(poses_of(still) - TOOL_FROM_CAMERA).max() < 1e-12
    led = recording_of(tmp_path / "led", write, pose_topic="/pose", pose_frame="camera_link")
    assert np.abs(poses_of(led) - WORLD_FROM_CAMERAS).max() < 1e-12


def test_a_bag_without_transforms_names_its_topics_of_poses(tmp_path: Path) -> None:
    with pytest.raises(BadData, match="got no transforms.*record /tf and /tf_static"):
        recording_of(tmp_path / "none", lambda bag: None)
    with pytest.raises(BadData, match="got no transforms, but poses in /pose.*pass --pose-topic /pose"):
        recording_of(tmp_path / "poses", lambda bag: poses_on(bag, "PoseStamped", WORLD_FROM_TOOLS))


def test_a_frame_with_the_axes_of_a_body_is_turned(tmp_path: Path) -> None:
    # x right, y down, z forward of the camera are -y, -z, x of the body.
    body_from_optical = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    read = recording_of(tmp_path / "scan", write_tf, camera_frame="camera_link", camera_axes="body")
    plain = recording_of(tmp_path / "plain", write_tf, camera_frame="camera_link")
    assert np.abs(poses_of(read) - poses_of(plain) @ body_from_optical).max() < 1e-12
    assert np.array_equal(plain.cameras[0].otherwise["--camera-axes body"], poses_of(read))
    assert not any("--camera-" in name for name in recording_of(tmp_path / "optical", write_tf).cameras[0].otherwise)


def test_images_in_a_frame_that_is_not_optical_are_tried_in_those_below(tmp_path: Path) -> None:
    bag = BagWriter(tmp_path / "scan", "mcap")
    write_tf(bag)
    write_images(bag, frame="camera_link")
    [camera] = rosbag.read(bag.close(), RosbagOptions()).cameras
    assert np.abs(camera.otherwise[f"--camera-frame {OPTICAL}"] - WORLD_FROM_CAMERAS).max() < 1e-12


def test_a_recording_of_realsense_viewer_is_named(tmp_path: Path) -> None:
    bag = BagWriter(tmp_path / "scan", "bag-lz4")
    for name, encoding, pixels in (("Depth_0", "mono16", DEPTH[0]), ("Color_0", "rgb8", COLOR[0])):
        bag.write(f"/device_0/sensor_0/{name}/image/data", START, bag.image(START, "0", encoding, pixels))
    with pytest.raises(BadData, match="got a recording of RealSense Viewer, which holds no poses.*ingest colmap"):
        rosbag.read(bag.close(), RosbagOptions())
