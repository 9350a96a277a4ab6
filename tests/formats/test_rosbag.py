from __future__ import annotations

import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

from bask_data.errors import BadData, MissingDependency, UsageError
from bask_data.formats import FORMATS, rosbag
from bask_data.formats.options.rosbag import RosbagOptions
from bask_data.formats.recording import CameraRecording, PreparedRecording
from bask_data.formats.rosbag import files as rosbag_files
from tests.formats.bags import (
    COLOR,
    COLOR_TOPIC,
    DEPTH,
    DEPTH_TOPIC,
    INFO_TOPIC,
    KINDS,
    OPTICAL,
    STAMPS,
    START,
    TOOL_FROM_CAMERA,
    WORLD_FROM_CAMERAS,
    WORLD_FROM_TOOLS,
    BagWriter,
    write_images,
    write_recording,
    write_tf,
)
from tests.formats.folders import K


def read(source: Path, **options: object) -> PreparedRecording:
    [format] = [item for item in FORMATS if item.name == "rosbag"]
    return format.read(source, RosbagOptions(**options))


def camera_of(source: Path, **options: object) -> CameraRecording:
    [camera] = read(source, **options).cameras
    return camera


@pytest.mark.parametrize("kind", KINDS)
def test_images_are_joined_by_header_stamps_with_poses_of_tf(tmp_path: Path, kind: str) -> None:
    recording = read(write_recording(tmp_path / "scan", kind))
    [camera] = recording.cameras
    assert camera.n_frames == 4
    assert np.abs(camera.time - np.array(STAMPS) / 1e9).max() < 1e-6
    assert np.abs(camera.world_from_cameras - WORLD_FROM_CAMERAS).max() < 1e-12
    assert np.array_equal(camera.K, K) and camera.distortion is None
    for i in (0, 1, 2, 3, 1, 0, 3):
        rgb, raw = camera.read(i)
        assert np.array_equal(rgb, COLOR[i])
        assert np.array_equal(raw, DEPTH[i])
    assert camera.depth_scale == 0.001
    assert "base -> tool0 -> camera_link -> camera_color_optical_frame" in recording.assumptions["pose"]
    assert recording.robot is not None and recording.robot.world_from_gripper is not None
    assert np.abs(recording.robot.world_from_gripper - WORLD_FROM_TOOLS).max() < 1e-12


def test_a_storage_file_is_read_without_its_folder(tmp_path: Path) -> None:
    folder = write_recording(tmp_path / "scan")
    assert camera_of(folder / "scan.mcap").n_frames == 4
    assert [path.name for path in read(folder).files] == ["metadata.yaml", "scan.mcap"]


def test_a_file_without_an_index_is_read_from_its_data(tmp_path: Path) -> None:
    for kind in ("mcap", "mcap-zstd"):
        file = write_recording(tmp_path / kind, kind) / f"{kind}.mcap"
        content = bytearray(file.read_bytes())
        content[-28:-20] = bytes(8)  # Where the summary begins: nowhere.
        file.write_bytes(content)
        camera = camera_of(file)
        assert np.abs(camera.world_from_cameras - WORLD_FROM_CAMERAS).max() < 1e-12
        assert np.array_equal(camera.read(3)[1], DEPTH[3])


def test_messages_may_be_in_big_endian(tmp_path: Path) -> None:
    bag = BagWriter(tmp_path / "scan", "mcap", little_endian=False)
    write_tf(bag)
    write_images(bag)
    camera = camera_of(bag.close())
    assert np.abs(camera.time - np.array(STAMPS) / 1e9).max() < 1e-6
    assert np.abs(camera.world_from_cameras - WORLD_FROM_CAMERAS).max() < 1e-12
    assert np.array_equal(camera.read(2)[0], COLOR[2])


def test_poses_are_interpolated_between_transforms_and_never_beyond_them(tmp_path: Path) -> None:
    bag = BagWriter(tmp_path / "scan", "db3")
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 0, 3] = [0.0, 0.1, 0.2]
    # From half an interval before the second image to half of one before the last.
    write_tf(bag, [STAMPS[0] + 50_000_000 + i * 100_000_000 for i in range(3)], list(poses))
    write_images(bag)
    recording = read(bag.close())
    [camera] = recording.cameras
    assert camera.n_frames == 2
    base_from_tool = camera.world_from_cameras @ np.linalg.inv(TOOL_FROM_CAMERA)
    assert np.allclose(base_from_tool[:, 0, 3], [0.05 + 1e-9, 0.15 + 2e-9], atol=1e-12)
    assert recording.assumptions["frames"] == "2 of 4; 2 left out: 000000 (no pose), 000003 (no pose)"


def test_transforms_too_far_apart_are_not_interpolated(tmp_path: Path) -> None:
    bag = BagWriter(tmp_path / "scan", "mcap")
    moving = [START - 10**8, START + 10**7, STAMPS[3] - 10**7, STAMPS[3] + 10**7]
    write_tf(bag, moving)
    write_images(bag)
    path = bag.close()
    assert camera_of(path, max_pose_gap=0.15).n_frames == 2
    assert camera_of(path, max_pose_gap=0.5).n_frames == 4


def test_depth_is_the_nearest_in_time_and_frames_without_are_left_out(tmp_path: Path) -> None:
    bag = BagWriter(tmp_path / "scan", "bag")
    write_tf(bag)
    for i, stamp in enumerate(STAMPS):
        bag.write(INFO_TOPIC, stamp, bag.info(stamp))
        bag.write(COLOR_TOPIC, stamp, bag.image(stamp, OPTICAL, "rgb8", COLOR[i]))
        if i != 1:
            near = bag.image(stamp - 4_000_000, OPTICAL, "16UC1", DEPTH[i])
            far = bag.image(stamp + 6_000_000, OPTICAL, "16UC1", DEPTH[0] + 1)
            bag.write(DEPTH_TOPIC, stamp, near)
            bag.write(DEPTH_TOPIC, stamp, far)
    recording = read(bag.close())
    [camera] = recording.cameras
    assert [np.array_equal(camera.read(k)[1], DEPTH[i]) for k, i in enumerate((0, 2, 3))] == [True] * 3
    assert recording.assumptions["frames"] == "3 of 4; 1 left out: 000001 (no depth)"


def test_images_that_arrive_in_another_order_are_sorted_and_repeated_ones_left_out(tmp_path: Path) -> None:
    bag = BagWriter(tmp_path / "scan", "mcap")
    write_tf(bag)
    for arrival, i in enumerate((0, 2, 1, 1, 3)):
        bag.write(INFO_TOPIC, START + arrival, bag.info(STAMPS[i]))
        bag.write(COLOR_TOPIC, START + arrival, bag.image(STAMPS[i], OPTICAL, "rgb8", COLOR[i]))
        bag.write(DEPTH_TOPIC, START + arrival, bag.image(STAMPS[i], OPTICAL, "16UC1", DEPTH[i]))
    recording = read(bag.close())
    [camera] = recording.cameras
    assert [np.array_equal(camera.read(i)[0], COLOR[i]) for i in range(4)] == [True] * 4
    assert "1 left out: 000002 (repeated stamp)" in recording.assumptions["frames"]


def test_empty_stamps_are_refused_and_arrival_is_offered(tmp_path: Path) -> None:
    bag = BagWriter(tmp_path / "scan", "mcap")
    write_tf(bag)
    for i, stamp in enumerate(STAMPS):
        bag.write(INFO_TOPIC, stamp, bag.info(0))
        bag.write(COLOR_TOPIC, stamp, bag.image(0, OPTICAL, "rgb8", COLOR[i]))
        bag.write(DEPTH_TOPIC, stamp, bag.image(0, OPTICAL, "16UC1", DEPTH[i]))
    path = bag.close()
    with pytest.raises(
        BadData, match=r"image_raw: header.stamp: expected the times .* got 0 in 4 of 4.*--stamps arrival"
    ):
        read(path)
    assert np.abs(camera_of(path, stamps="arrival").world_from_cameras - WORLD_FROM_CAMERAS).max() < 1e-12


def test_depth_of_another_camera_has_its_own_calibration_and_pose(tmp_path: Path) -> None:
    bag = BagWriter(tmp_path / "scan", "mcap")
    write_tf(bag)
    color_from_depth = np.eye(4)
    color_from_depth[0, 3] = 0.015
    bag.write("/tf_static", START, bag.transforms((0, OPTICAL, "camera_depth_optical_frame", color_from_depth)))
    half = np.diag([0.5, 0.5, 1]) @ K
    for i, stamp in enumerate(STAMPS):
        bag.write(INFO_TOPIC, stamp, bag.info(stamp))
        bag.write(COLOR_TOPIC, stamp, bag.image(stamp, OPTICAL, "rgb8", COLOR[i]))
        depth = bag.image(stamp, "camera_depth_optical_frame", "16UC1", np.full((6, 8), 1000, np.uint16))
        bag.write("/camera/depth/image_rect_raw", stamp, depth)
        info = bag.info(stamp, "camera_depth_optical_frame", half, height=6, width=8)
        bag.write("/camera/depth/camera_info", stamp, info)
    path = bag.close()
    [camera] = rosbag.read(path, RosbagOptions()).cameras
    assert camera.color_from_depth is not None and np.abs(camera.color_from_depth - color_from_depth).max() < 1e-12
    assert camera.depth_lens is not None and np.array_equal(camera.depth_lens.K, half)
    assert (camera.depth(0) == 1000).all()
    recording = read(path, trust=True)
    assert recording.cameras[0].read(0)[1].shape == COLOR.shape[1:3]
    assert "was registered into colour" in recording.assumptions["alignment"]


def test_several_cameras_are_listed_and_chosen_by_their_topics(tmp_path: Path) -> None:
    bag = BagWriter(tmp_path / "scan", "mcap")
    write_tf(bag)
    bag.write("/tf_static", START, bag.transforms((0, "elsewhere", "elsewhere_optical", TOOL_FROM_CAMERA)))
    for name in ("wrist", "overhead"):
        frame = f"{name}_optical"
        bag.write(
            "/tf_static", START, bag.transforms((0, "tool0" if name == "wrist" else "base", frame, TOOL_FROM_CAMERA))
        )
        for i, stamp in enumerate(STAMPS):
            # The second camera misses an image, and takes the others a little later.
            if (name, i) == ("overhead", 2):
                continue
            stamp += 4_000_000 if name == "overhead" else 0
            bag.write(f"/{name}/color/camera_info", stamp, bag.info(stamp, frame))
            bag.write(f"/{name}/color/image_raw", stamp, bag.image(stamp, frame, "rgb8", COLOR[i]))
            bag.write(f"/{name}/depth/image_raw", stamp, bag.image(stamp, frame, "16UC1", DEPTH[i]))
    path = bag.close()
    with pytest.raises(BadData, match=r"--color-topic and --depth-topic") as caught:
        read(path)
    assert "/wrist/color/image_raw: sensor_msgs/Image, 4" in "\n".join(caught.value.__notes__)
    assert "/tf: tf2_msgs/TFMessage, 4" in "\n".join(caught.value.__notes__)
    one = camera_of(path, color_topic="/wrist/color/image_raw", depth_topic="/wrist/depth/image_raw")
    assert np.abs(one.world_from_cameras - WORLD_FROM_CAMERAS).max() < 1e-12
    topics = {f"{kind}_topic": f"/{{camera}}/{kind}/image_raw" for kind in ("color", "depth")}
    both = read(path, camera="wrist,overhead", **topics)
    # They share the robot's states, so a frame that one lacks is left out.
    assert [camera.n_frames for camera in both.cameras] == [3, 3]
    assert np.abs(both.cameras[1].world_from_cameras - TOOL_FROM_CAMERA).max() < 1e-12
    assert np.array_equal(both.cameras[1].read(2)[0], COLOR[3])
    with pytest.raises(UsageError, match="--pose-frame: expected a frame for each of several cameras"):
        read(path, camera="wrist,overhead", pose_topic="/pose", **topics)
    with pytest.raises(BadData, match="expected all cameras in one tree, got base of wrist, elsewhere of overhead"):
        read(path, camera="wrist,overhead", camera_frame="overhead=elsewhere_optical", **topics)
    with pytest.raises(UsageError, match="expected a topic for each camera"):
        read(path, camera="wrist,overhead", color_topic="wrist=/wrist/color/image_raw;overhead=/wrist/color/image_raw")


def test_a_topic_that_is_not_there_is_refused_with_those_that_are(tmp_path: Path) -> None:
    path = write_recording(tmp_path / "scan")
    with pytest.raises(BadData, match="expected a topic of images, got /rgb") as caught:
        read(path, color_topic="/rgb")
    assert COLOR_TOPIC in "\n".join(caught.value.__notes__)
    bag = BagWriter(tmp_path / "other", "mcap")
    write_tf(bag)
    bag.write(COLOR_TOPIC, START, bag.image(START, OPTICAL, "rgb8", COLOR[0]))
    with pytest.raises(BadData, match="expected images of depth"):
        read(bag.close())


def test_episodes_are_the_bags_of_a_folder_and_split_ones_are_joined(tmp_path: Path) -> None:
    for name in ("pick_1", "pick_2"):
        write_recording(tmp_path / name, "bag")
    options = RosbagOptions()
    assert rosbag.episodes(tmp_path, options) == ("pick_1", "pick_2")
    assert rosbag.episodes(tmp_path / "pick_1.bag", options) == ()
    with pytest.raises(UsageError, match="expected one of pick_1, pick_2"):
        read(tmp_path)
    assert camera_of(tmp_path, episode="2").n_frames == 4
    split = tmp_path / "split"
    split.mkdir()
    first, second = BagWriter(split / "a_0", "bag"), BagWriter(split / "a_1", "bag")
    write_tf(first)
    write_images(second)
    first.close()
    second.close()
    assert np.abs(camera_of(split, split=True).world_from_cameras - WORLD_FROM_CAMERAS).max() < 1e-12
    with pytest.raises(UsageError, match="expected a bag of ROS 1 or ROS 2, got a folder without one"):
        read(_empty(tmp_path))
    with pytest.raises(UsageError, match="expected a file .bag, .mcap or .db3, or a folder, got a file .txt"):
        read(_text(tmp_path))


def _empty(tmp_path: Path) -> Path:
    (tmp_path / "empty").mkdir()
    return tmp_path / "empty"


def _text(tmp_path: Path) -> Path:
    (tmp_path / "a.txt").write_text("x")
    return tmp_path / "a.txt"


def test_the_width_of_a_gripper_is_the_sum_of_joints_between_their_messages(tmp_path: Path) -> None:
    bag = BagWriter(tmp_path / "scan", "mcap")
    write_tf(bag)
    write_images(bag)
    for i in range(6):
        stamp = START - 50_000_000 + i * 100_000_000
        positions = np.array([9.0, 0.01 * i, 0.01 * i])
        state = bag.make(
            "sensor_msgs/msg/JointState",
            header=bag.header(stamp, ""),
            name=["elbow", "left", "right"],
            position=positions,
            velocity=np.zeros(0),
            effort=np.zeros(0),
        )
        bag.write("/joint_states", stamp, state)
    path = bag.close()
    robot = read(path, gripper_joints="left,right").robot
    assert robot is not None and robot.gripper_width is not None
    assert np.allclose(robot.gripper_width, 0.01 + 0.02 * np.arange(4), atol=1e-8)
    with pytest.raises(BadData, match="expected joints among elbow, left, right, got thumb"):
        read(path, gripper_joints="thumb")


@pytest.mark.parametrize("kind", KINDS)
def test_damaged_bags_are_refused_with_their_name(tmp_path: Path, kind: str) -> None:
    path = write_recording(tmp_path / "scan", kind)
    file = path if path.is_file() else next(file for file in path.iterdir() if file.suffix in (".mcap", ".db3"))
    content = file.read_bytes()
    for n_kept in (0, 5, 100, len(content) // 2, len(content) - 20):
        file.write_bytes(content[:n_kept])
        with pytest.raises(BadData, match=file.name):
            camera_of(path).read(3)
    rng = np.random.default_rng(0)
    for _ in range(20):
        broken = bytearray(content)
        for at in rng.integers(0, len(content), 40):
            broken[at] = rng.integers(256)
        file.write_bytes(broken)
        try:
            camera = camera_of(path, trust=True)
            for i in range(camera.n_frames):
                camera.read(i)
        except (BadData, UsageError):
            continue


def test_chunks_that_decompress_without_end_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("bask_data.formats.rosbag.files.MAX_IMAGE_BYTES", 1000)
    for kind in ("bag-bz2", "bag-lz4", "mcap-zstd"):
        with pytest.raises(BadData, match="expected at most 1000 bytes, got more, decompressed"):
            read(write_recording(tmp_path / kind, kind))


def test_chunks_of_a_file_without_an_index_are_bounded_before_its_topics_are_known(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = write_recording(tmp_path / "scan", "mcap-zstd") / "scan.mcap"
    content = bytearray(file.read_bytes())
    content[-28:-20] = bytes(8)
    file.write_bytes(content)
    monkeypatch.setattr("bask_data.formats.rosbag.files.MAX_IMAGE_BYTES", 1000)
    monkeypatch.setattr("rosbags.rosbag2.storage_mcap.decompress", None)
    with pytest.raises(BadData, match="expected at most 1000 bytes, got more, decompressed"):
        read(file)


def test_metadata_may_not_name_files_elsewhere(tmp_path: Path) -> None:
    path = write_recording(tmp_path / "scan")
    shutil.move(path / "scan.mcap", tmp_path / "scan.mcap")
    about = path / "metadata.yaml"
    about.write_text(about.read_text().replace("- scan.mcap", "- ../scan.mcap"))
    with pytest.raises(BadData, match="scan/scan.mcap: metadata.yaml: expected a file, got no such path"):
        read(path)
    (path / "scan.mcap").symlink_to(tmp_path / "scan.mcap")
    with pytest.raises(BadData, match="got a link out of it"):
        read(path)
    assert camera_of(path, follow_links=True).n_frames == 4
    about.write_text("rosbag2_bagfile_information: {relative_file_paths: [[scan.mcap]]}")
    with pytest.raises(BadData, match=r"relative_file_paths: expected the names of files"):
        read(path)
    about.write_text("rosbag2_bagfile_information: 3")
    with pytest.raises(BadData, match=r"relative_file_paths: expected the names of files"):
        read(path)


def test_a_link_to_the_folder_of_a_bag_elsewhere_is_refused(tmp_path: Path) -> None:
    path = write_recording(tmp_path / "elsewhere")
    (tmp_path / "bags").mkdir()
    (tmp_path / "bags/scan").symlink_to(path)
    with pytest.raises(BadData, match="got a link out of it"):
        read(tmp_path / "bags")
    assert camera_of(tmp_path / "bags", follow_links=True).n_frames == 4


def test_files_compressed_as_a_whole_are_refused_with_a_way_out(tmp_path: Path) -> None:
    path = write_recording(tmp_path / "scan")
    (path / "scan.mcap").rename(path / "scan.mcap.zstd")
    about = path / "metadata.yaml"
    about.write_text(about.read_text().replace("scan.mcap", "scan.mcap.zstd"))
    with pytest.raises(BadData, match=r"got zstd.*zstd -d .*\*.zstd"):
        read(path)
    (path / "scan.mcap.zstd").rename(path / "scan.mcap")
    assert camera_of(path).n_frames == 4


def test_a_pose_in_the_file_of_a_hand_eye_calibration_takes_the_place_of_tf(tmp_path: Path) -> None:
    bag = BagWriter(tmp_path / "scan", "mcap")
    for stamp, pose in zip(STAMPS, WORLD_FROM_TOOLS, strict=True):
        bag.write("/tf", stamp, bag.transforms((stamp, "base", "flange", pose)))
    write_images(bag)
    path = bag.close()
    with pytest.raises(BadData, match=f"expected the camera's frame '{OPTICAL}'.*got frames base, flange"):
        read(path)
    hand_eye = tmp_path / "gripper_from_camera.txt"
    np.savetxt(hand_eye, TOOL_FROM_CAMERA)
    with pytest.raises(UsageError, match="--gripper-frame: expected the gripper's frame, one of base, flange"):
        read(path, gripper_from_camera=str(hand_eye))
    recording = read(path, gripper_from_camera=str(hand_eye), gripper_frame="flange")
    assert np.abs(recording.cameras[0].world_from_cameras - WORLD_FROM_CAMERAS).max() < 1e-9
    assert recording.robot is not None and recording.robot.world_from_gripper is not None
    assert np.abs(recording.robot.world_from_gripper - WORLD_FROM_TOOLS).max() < 1e-9
    assert hand_eye in recording.files


def test_worlds_that_are_not_there_are_refused(tmp_path: Path) -> None:
    path = write_recording(tmp_path / "scan")
    with pytest.raises(UsageError, match="--world: expected a frame of tf: base, camera_color_optical_frame"):
        read(path, world="map")
    # In the tool's own frame the camera stands still.
    still = camera_of(path, world="tool0", trust=True)
    assert np.abs(still.world_from_cameras - TOOL_FROM_CAMERA).max() < 1e-12


def test_chunks_of_bz2_are_decompressed_once_unless_there_is_no_room(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_recording(tmp_path / "scan", "bag-bz2")
    unpacked: list[str] = []
    decompress = rosbag_files.decompressed

    def counted(path: Path, data: bytes, compression: str) -> bytes:
        unpacked.append(compression)
        return decompress(path, data, compression)

    monkeypatch.setattr(rosbag_files, "decompressed", counted)
    monkeypatch.setattr(rosbag_files, "N_CHUNKS_KEPT", 0)
    for folder, n_times in ((str(tmp_path), 1), ("/proc", None)):
        monkeypatch.setattr("bask_data.formats.rosbag.spool.SPOOL_FOLDER", folder)
        unpacked.clear()
        [camera] = rosbag.read(path, RosbagOptions()).cameras
        assert [np.array_equal(camera.color(i), COLOR[i]) for i in range(4)] == [True] * 4
        assert len(unpacked) == n_times if n_times else len(unpacked) > 4


def test_a_missing_library_is_named_with_its_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_recording(tmp_path / "scan")
    monkeypatch.setitem(sys.modules, "rosbags", None)
    with pytest.raises(MissingDependency, match=r"pip install 'bask-data\[formats\]'"):
        read(path)
