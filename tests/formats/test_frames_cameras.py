from __future__ import annotations

from pathlib import Path

import numpy as np
import pydantic
import pytest

from bask_data.errors import BadData, UsageError
from bask_data.formats.options.frames import FramesOptions
from tests.formats.folders import images, rigid, write_image
from tests.formats.test_frames import read

POSES = np.stack([rigid(np.random.default_rng(i)) for i in range(3)])
PATTERNS = {
    "camera": "wrist,overhead",
    "color": "{camera}/rgb_*.png",
    "depth": "{camera}/depth_*.png",
    "pose": "{camera}/poses.txt",
    "intrinsics": "{camera}/K.txt",
}


def write_cameras(folder: Path) -> None:
    """A wrist camera with a pose per frame, and an overhead camera that rests and has other intrinsics."""
    for seed, (name, poses, focal) in enumerate((("wrist", POSES, 20), ("overhead", POSES[:1], 30))):
        color, depth = images(3, seed)
        for i in range(3):
            write_image(folder / name / f"rgb_{i}.png", color[i])
            write_image(folder / name / f"depth_{i}.png", depth[i])
        np.savetxt(folder / name / "poses.txt", poses.reshape(-1, 16))
        (folder / name / "K.txt").write_text(f"{focal} {focal} 7.5 5.5")


def test_each_camera_has_its_own_files_poses_and_intrinsics(tmp_path: Path) -> None:
    write_cameras(tmp_path)
    recording = read(tmp_path, **PATTERNS)
    wrist, overhead = recording.cameras
    assert (wrist.name, overhead.name, wrist.K[0, 0], overhead.K[0, 0]) == ("wrist", "overhead", 20, 30)
    assert np.allclose(wrist.world_from_cameras, POSES, atol=1e-9)
    assert np.allclose(overhead.world_from_cameras, POSES[[0, 0, 0]], atol=1e-9)
    for seed, camera in enumerate((wrist, overhead)):
        assert np.array_equal(camera.read(2)[1], images(3, seed)[1][2])
    assert "the camera rests" in recording.assumptions["overhead: pose"]
    assert recording.assumptions["time"] == "frame number / 30 per second"
    assert len(recording.files) == len(set(recording.files)) == 16


def test_labels_and_the_lens_of_depth_are_each_cameras_own(tmp_path: Path) -> None:
    write_cameras(tmp_path)
    for label, name in enumerate(("wrist", "overhead"), 5):
        for i in range(3):
            write_image(tmp_path / name / f"labels_{i}.png", np.full((12, 16), label, np.uint8))
        (tmp_path / name / "K_depth.txt").write_text(f"{20 + label} {20 + label} 7.5 5.5")
    with pytest.raises(UsageError, match="--labels: expected a pattern with {camera}"):
        read(tmp_path, **PATTERNS, labels="wrist/labels_*.png")
    recording = read(
        tmp_path, **PATTERNS, labels="{camera}/labels_*.png", depth_intrinsics="{camera}/K_depth.txt", align="depth"
    )
    wrist, overhead = recording.cameras
    assert (wrist.K[0, 0], overhead.K[0, 0]) == (25, 26)
    for label, camera in ((5, wrist), (6, overhead)):
        assert camera.labels is not None and np.unique(camera.labels(1)).max() == label
    assert recording.label_names == {5: "label 5", 6: "label 6"}


def test_distortion_after_bare_numbers_must_be_decided(tmp_path: Path) -> None:
    write_cameras(tmp_path)
    (tmp_path / "wrist/K.txt").write_text("20 20 7.5 5.5 -0.28 0.09 0 0 0")
    with pytest.raises(
        BadData, match=r"K.txt: intrinsics: .* look like OpenCV's distortion: -0.28,0.09,0,0,0.*pinhole if"
    ):
        read(tmp_path, **PATTERNS)
    assert read(tmp_path, **PATTERNS, distortion="pinhole").cameras[0].distortion is None
    taken_out = read(tmp_path, **PATTERNS, distortion="opencv:-0.28,0.09,0,0,0").cameras[0].distortion
    assert taken_out is not None and taken_out.parameters == (-0.28, 0.09, 0, 0, 0)


def test_hand_eye_poses_and_a_table_give_the_robots_states_and_actions(tmp_path: Path) -> None:
    write_cameras(tmp_path)
    gripper_from_camera = rigid(np.random.default_rng(9))
    np.savetxt(tmp_path / "wrist/hand_eye.txt", gripper_from_camera)
    (tmp_path / "robot.csv").write_text("time,gripper_width,dx,dy\n0,0.08,1,2\n1,0.04,3,4\n2,0.0,5,6\n")
    options = {**PATTERNS, "gripper_from_camera": "{camera}/hand_eye.txt", "robot": "robot.csv"}
    recording = read(tmp_path, **options)
    wrist, overhead = recording.cameras
    assert np.allclose(wrist.world_from_cameras, POSES @ gripper_from_camera, atol=1e-9)
    assert np.allclose(overhead.world_from_cameras, POSES[[0, 0, 0]], atol=1e-9), "no robot carries it"
    robot = recording.robot
    assert robot is not None and robot.world_from_gripper is not None and robot.action is not None
    assert np.allclose(robot.world_from_gripper, POSES, atol=1e-9)
    assert robot.gripper_width is not None and robot.gripper_width.tolist() == [0.08, 0.04, 0.0]
    assert robot.action_names == ("dx", "dy") and robot.action.tolist() == [[1, 2], [3, 4], [5, 6]]
    assert tmp_path / "robot.csv" in recording.files


def test_a_hand_eye_calibration_of_no_camera_is_refused(tmp_path: Path) -> None:
    write_cameras(tmp_path)
    with pytest.raises(BadData, match="--gripper-from-camera: expected a calibration of at least one camera"):
        read(tmp_path, **PATTERNS, gripper_from_camera="{camera}/hand_eye.txt")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("gripper_width\n0.1\n0.2\n", "rows: expected 3, one for each frame, got 2"),
        ("0.1\n0.2\n0.3\n0.4\n", "header: expected distinct names of columns"),
        ("x,x\n1,2\n1,2\n1,2\n", "header: expected distinct names of columns"),
        ("\n", "header: expected distinct names of columns, such as gripper_width, got none"),
        ("x\n" + "1" * 200_000, "rows: expected values separated by commas, got field larger"),
        ("x,y\n1,2\n1\n1,2\n", "row 2: expected 2 numbers, got 1 values"),
        ("x,y\n1,2\n1,nan\n1,2\n", "row 2: expected 2 numbers, got 'nan'"),
    ],
)
def test_a_table_that_does_not_fit_the_frames_is_refused(tmp_path: Path, text: str, message: str) -> None:
    write_cameras(tmp_path)
    (tmp_path / "robot.csv").write_text(text)
    with pytest.raises(BadData, match=f"robot.csv: {message}"):
        read(tmp_path, **PATTERNS, robot="robot.csv")


def test_cameras_of_a_robot_must_have_as_many_frames(tmp_path: Path) -> None:
    write_cameras(tmp_path)
    for kind in ("rgb", "depth"):
        (tmp_path / f"overhead/{kind}_2.png").unlink()
    (tmp_path / "robot.csv").write_text("gripper_width\n0\n0\n0\n")
    with pytest.raises(
        BadData, match="expected as many of each camera, for the robot's states, got 3 of wrist, 2 of ove"
    ):
        read(tmp_path, **PATTERNS, robot="robot.csv")
    assert read(tmp_path, **PATTERNS).cameras[1].n_frames == 2


def test_names_of_cameras_must_be_names() -> None:
    with pytest.raises(pydantic.ValidationError):
        FramesOptions(camera="wrist,")
    with pytest.raises(UsageError, match="--camera: expected different names, got wrist,wrist"):
        read(Path(), camera="wrist,wrist")


def test_duplicate_times_are_named_by_file_and_line(tmp_path: Path) -> None:
    write_cameras(tmp_path)
    (tmp_path / "times.txt").write_text("# s\n100.0\n100.1\n100.1\n")
    with pytest.raises(
        BadData, match=r"times.txt: line 4: expected times that increase.* pass --fps without --timestamps"
    ):
        read(tmp_path, **PATTERNS, timestamps="times.txt")


def test_nanoseconds_are_recognised_and_stated(tmp_path: Path) -> None:
    write_cameras(tmp_path)
    stamps = [1604644894000000000 + i * 33333333 for i in range(3)]
    (tmp_path / "times.txt").write_text("\n".join(map(str, stamps)))
    recording = read(tmp_path, **PATTERNS, timestamps="times.txt")
    assert np.allclose(recording.cameras[0].time, np.array(stamps) / 1e9, atol=1e-6)
    assert recording.assumptions["time"] == "nanoseconds since 1970, from times.txt"
