from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bask_data.errors import BadData, UsageError
from bask_data.formats import FORMATS, tum
from bask_data.formats.options.tum import TumOptions
from bask_data.formats.recording import PreparedRecording
from tests.formats.folders import INTRINSICS, images, write_image

COLOR_TIME = [10.0, 10.1, 10.2, 10.3]
POSE_TIME = 9.97 + 0.04 * np.arange(10)
TURN = np.array([0.3, -0.8, 0.5])
"""Radians per second about each axis, together one axis: what Slerp follows exactly."""


def pose_at(time: float) -> np.ndarray:
    """A camera that turns about one axis and moves on a line, both evenly."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(TURN * (time - 10)).as_matrix()
    matrix[:3, 3] = [0.4 * (time - 10), 1.0, -0.3 * (time - 10)]
    return matrix


POSES = np.stack([pose_at(time) for time in COLOR_TIME])


def line_of(time: float, pose: np.ndarray, digits: int = 4) -> str:
    quat_xyzw = Rotation.from_matrix(pose[:3, :3]).as_quat()
    return f"{time:.{digits}f} " + " ".join(f"{value:.12f}" for value in (*pose[:3, 3], *quat_xyzw))


def read(source: Path, **options: object) -> PreparedRecording:
    tum_format = next(item for item in FORMATS if item.name == "tum")
    return tum_format.read(source, TumOptions(**{"intrinsics": INTRINSICS, "depth_scale": 0.001, **options}))


def write_sequence(
    folder: Path, depth_offset: float = 0.005, pose_time: Sequence[float] | np.ndarray = POSE_TIME
) -> None:
    color, depth = images(4)
    lines: dict[str, list[str]] = {"rgb": ["# color images"], "depth": ["# depth maps"]}
    for i, time in enumerate(COLOR_TIME):
        write_image(folder / f"rgb/{time:.6f}.png", color[i])
        write_image(folder / f"depth/{time + depth_offset:.6f}.png", depth[i])
        lines["rgb"].append(f"{time:.6f} rgb/{time:.6f}.png")
        lines["depth"].append(f"{time + depth_offset:.6f} depth/{time + depth_offset:.6f}.png")
    lines["groundtruth"] = ["# poses", *(line_of(time, pose_at(time)) for time in pose_time)]
    for name, content in lines.items():
        (folder / f"{name}.txt").write_text("\n".join(content))


def test_a_sequence_is_joined_by_time_with_poses_at_the_images_times(tmp_path: Path) -> None:
    write_sequence(tmp_path)
    recording = read(tmp_path)
    (camera,) = recording.cameras
    color, depth = images(4)
    assert camera.time.tolist() == COLOR_TIME
    assert np.abs(camera.world_from_cameras - POSES).max() < 1e-9
    for i in range(4):
        rgb, raw = camera.read(i)
        assert np.array_equal(rgb, color[i])
        assert np.array_equal(raw, depth[i])
    assert len(recording.files) == 3 + 8
    assert "frames" not in recording.assumptions
    assert "interpolated at the frames' times" in recording.assumptions["pose"]


def test_poses_of_the_images_own_times_are_taken_as_they_are_however_far_apart(tmp_path: Path) -> None:
    write_sequence(tmp_path)
    slow = [line_of(time, pose) for time, pose in zip(COLOR_TIME, POSES, strict=True)]
    (tmp_path / "KeyFrameTrajectory.txt").write_text("\n".join([slow[0], slow[3]]))
    recording = read(tmp_path, trajectory="KeyFrameTrajectory.txt")
    assert recording.cameras[0].time.tolist() == [10.0, 10.3]
    assert np.abs(recording.cameras[0].world_from_cameras - POSES[[0, 3]]).max() < 1e-9
    assert read(tmp_path, trajectory="KeyFrameTrajectory.txt", max_pose_gap=0.31).cameras[0].n_frames == 4


def test_stamps_rounded_to_milliseconds_are_those_of_their_images(tmp_path: Path) -> None:
    write_sequence(tmp_path)
    for name in ("rgb.txt", "depth.txt"):
        text = (tmp_path / name).read_text()
        (tmp_path / name).write_text(re.sub(r"^(\d+\.\d\d\d)\d+ ", r"\g<1>437 ", text, flags=re.MULTILINE))
    keys = "\n".join(line_of(time, pose, digits=3) for time, pose in zip(COLOR_TIME, POSES, strict=True))
    (tmp_path / "keys.txt").write_text(keys)
    recording = read(tmp_path, trajectory="keys.txt", max_pose_gap=0.0)
    assert recording.cameras[0].time[0] == 10.000437
    assert np.abs(recording.cameras[0].world_from_cameras - POSES).max() < 1e-9


def test_a_missing_groundtruth_is_reported_with_the_trajectory_that_is_there(tmp_path: Path) -> None:
    write_sequence(tmp_path)
    (tmp_path / "groundtruth.txt").rename(tmp_path / "CameraTrajectory.txt")
    with pytest.raises(BadData, match="got no such path.  fix: pass --trajectory CameraTrajectory.txt"):
        read(tmp_path)
    assert read(tmp_path, trajectory="CameraTrajectory.txt").cameras[0].n_frames == 4


def test_clocks_of_lists_and_poses_may_be_in_different_units(tmp_path: Path) -> None:
    write_sequence(tmp_path)
    start = 1_700_000_000
    for name in ("rgb", "depth"):
        lines = (tmp_path / f"{name}.txt").read_text().splitlines()[1:]
        words = [line.split() for line in lines]
        stamps = "\n".join(f"{start + float(time):.6f} {file}" for time, file in words)
        (tmp_path / f"{name}.txt").write_text(stamps)
    poses = [line_of(time, pose_at(time)).split(maxsplit=1) for time in POSE_TIME]
    text = "\n".join(f"{start * 10**9 + round(float(time) * 10**9)} {rest}" for time, rest in poses)
    (tmp_path / "groundtruth.txt").write_text(text)
    recording = read(tmp_path)
    assert np.abs(recording.cameras[0].world_from_cameras - POSES).max() < 1e-6
    assert "nanoseconds since 1970, from groundtruth.txt" in recording.assumptions["pose"]


@pytest.mark.parametrize("depth_first", [False, True])
def test_colour_and_depth_can_be_paired_by_a_file(tmp_path: Path, depth_first: bool) -> None:
    write_sequence(tmp_path, depth_offset=0.5)
    pairs = [[f"{t:.6f} rgb/{t:.6f}.png", f"{t + 0.5:.6f} depth/{t + 0.5:.6f}.png"] for t in COLOR_TIME]
    (tmp_path / "pairs.txt").write_text("\n".join(" ".join(pair[:: -1 if depth_first else 1]) for pair in pairs))
    (camera,) = read(tmp_path, associations="pairs.txt").cameras
    assert camera.time.tolist() == COLOR_TIME
    assert np.array_equal(camera.read(3)[1], images(4)[1][3])
    (tmp_path / "rgb.txt").unlink()
    (tmp_path / "pairs.txt").rename(tmp_path / "associations.txt")
    with pytest.raises(
        BadData, match="rgb.txt: images: .* got no such path.  fix: pass --associations associations.txt"
    ):
        read(tmp_path)
    (tmp_path / "pairs.txt").write_text("10.0 rgb/10.000000.png\n")
    with pytest.raises(BadData, match="lines: expected `time file time file` in each, got another in line 1"):
        read(tmp_path, associations="pairs.txt")


def test_frames_without_depth_or_pose_close_enough_are_left_out_and_counted(tmp_path: Path) -> None:
    write_sequence(tmp_path)
    lines = (tmp_path / "depth.txt").read_text().splitlines()
    (tmp_path / "depth.txt").write_text("\n".join(lines[:2] + lines[3:]))
    lines = (tmp_path / "groundtruth.txt").read_text().splitlines()
    (tmp_path / "groundtruth.txt").write_text("\n".join(lines[:-1]))
    (camera,) = read(tmp_path).cameras
    assert camera.time.tolist() == [10.0, 10.2]
    assert np.abs(camera.world_from_cameras - POSES[[0, 2]]).max() < 1e-9
    assert np.array_equal(camera.read(1)[0], images(4)[0][2])
    assert read(tmp_path).assumptions["frames"] == (
        "2 of 4; 2 left out: rgb/10.100000.png (no depth), rgb/10.300000.png (no pose)"
    )


def test_images_that_are_listed_and_not_there_are_refused_or_left_out(tmp_path: Path) -> None:
    write_sequence(tmp_path)
    (tmp_path / "rgb/10.000000.png").unlink()
    (tmp_path / "depth/10.205000.png").unlink()
    with pytest.raises(BadData, match="10.000000.png: colour: expected a file, got no such path"):
        read(tmp_path)
    assert read(tmp_path, skip_bad=True).cameras[0].time.tolist() == [10.1, 10.3]
    for path in (tmp_path / "rgb").iterdir():
        path.unlink()
    with pytest.raises(BadData, match="10.000000.png: colour: expected a file, got no such path"):
        read(tmp_path, skip_bad=True)


def test_a_sequence_without_any_frame_in_time_is_refused(tmp_path: Path) -> None:
    write_sequence(tmp_path, depth_offset=0.05)
    with pytest.raises(
        BadData,
        match="timestamps: expected colour and depth within 0.02 s, and poses around them, got none of 4 colour",
    ):
        read(tmp_path)
    write_sequence(tmp_path, pose_time=POSE_TIME + 100)
    with pytest.raises(
        BadData,
        match="groundtruth.txt: time: expected poses around the frames' times, 10.000000 to 10.300000 s, got 109",
    ):
        read(tmp_path)


def test_other_readings_of_the_poses_are_compared(tmp_path: Path) -> None:
    write_sequence(tmp_path)
    text = (tmp_path / "groundtruth.txt").read_text().splitlines()[1:]
    wxyz = [" ".join([*(words := line.split())[:4], words[7], *words[4:7]]) for line in text]
    (tmp_path / "wxyz.txt").write_text("\n".join(wxyz))
    (camera,) = tum.read(tmp_path, TumOptions(intrinsics=INTRINSICS, trajectory="wxyz.txt")).cameras
    assert np.abs(camera.otherwise["--quat wxyz"] - POSES).max() < 1e-9
    (camera,) = read(tmp_path, trajectory="wxyz.txt", quat="wxyz").cameras
    assert np.abs(camera.world_from_cameras - POSES).max() < 1e-9


def test_the_benchmarks_intrinsics_are_known_by_the_rigs_name(tmp_path: Path) -> None:
    write_sequence(tmp_path)
    with pytest.raises(
        BadData, match=r"expected a principal point near the middle of images of 16x12, got \(318.6, 255.3\)"
    ):
        read(tmp_path, intrinsics="freiburg1")
    with pytest.raises(UsageError, match="--intrinsics"):
        read(tmp_path, intrinsics="")


def test_lists_in_another_layout_than_the_benchmarks_are_refused(tmp_path: Path) -> None:
    write_sequence(tmp_path)
    good = (tmp_path / "rgb.txt").read_text()
    (tmp_path / "rgb.txt").write_text("10.0")
    with pytest.raises(BadData, match="rgb.txt: lines: expected `timestamp file` in each"):
        read(tmp_path)
    (tmp_path / "rgb.txt").write_text("\n".join(reversed(good.splitlines())))
    with pytest.raises(
        BadData,
        match="rgb.txt: line 2: expected times that increase, got 10.2 after 10.3",
    ):
        read(tmp_path)
    (tmp_path / "rgb.txt").write_text(good.replace("rgb/10.0", "../rgb/10.0"))
    with pytest.raises(BadData, match="expected a path inside the source folder"):
        read(tmp_path)
    (tmp_path / "rgb.txt").write_text(good)
    (tmp_path / "groundtruth.txt").write_text("10.0 1 2 3\n")
    with pytest.raises(BadData, match="groundtruth.txt: pose: expected blocks of 4 lines"):
        read(tmp_path)
    (tmp_path / "groundtruth.txt").write_text("1 2 3 0 0 0 1\n")
    with pytest.raises(BadData, match="groundtruth.txt: lines: expected `timestamp tx ty tz qx qy qz qw` in each"):
        read(tmp_path)
    (tmp_path / "rgb.txt").write_text("soon rgb/10.000000.png")
    with pytest.raises(BadData, match="rgb.txt: lines: expected times that are numbers"):
        read(tmp_path)


def test_an_invalid_pose_is_named_by_its_line(tmp_path: Path) -> None:
    write_sequence(tmp_path)
    text = (tmp_path / "groundtruth.txt").read_text().splitlines()
    text[1] = "9.97 0 0 0 0 0 0 2"
    (tmp_path / "groundtruth.txt").write_text("\n".join(text))
    with pytest.raises(BadData, match="groundtruth.txt: line 2: pose: expected a quaternion of length 1, got length 2"):
        read(tmp_path)
