from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bask_data.errors import BadData
from bask_data.formats.recording import SourceCamera
from tests.formats.folders import INTRINSICS, rigid, write_frames
from tests.formats.test_frames import read


def source_camera(folder: Path, **options: object) -> SourceCamera:
    from bask_data.formats.frames import read as read_source
    from bask_data.formats.options.frames import FramesOptions

    return read_source(folder, FramesOptions(**{"intrinsics": INTRINSICS, **options})).cameras[0]


POSES = np.stack([rigid(np.random.default_rng(i)) for i in range(4)])


def pose_at(time: float) -> np.ndarray:
    """Turns about one axis and moves on a line, both evenly."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(np.array([0.3, -0.8, 0.5]) * time).as_matrix()
    matrix[:3, 3] = [0.4 * time, 1.0, -0.3 * time]
    return matrix


def lines(keys: list[str], poses: np.ndarray) -> str:
    quat_xyzw = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    values = np.c_[poses[:, :3, 3], quat_xyzw]
    return "\n".join(f"{key} " + " ".join(f"{x:.15g}" for x in row) for key, row in zip(keys, values, strict=True))


def test_one_pose_is_that_of_a_camera_that_rests(tmp_path: Path) -> None:
    write_frames(tmp_path, POSES)
    np.savetxt(tmp_path / "pose.txt", POSES[2])
    recording = read(tmp_path, pose="pose.txt")
    assert np.allclose(recording.cameras[0].world_from_cameras, POSES[[2, 2, 2, 2]], atol=1e-9)
    assert "one pose for all frames: the camera rests" in recording.assumptions["pose"]


@pytest.mark.parametrize("inverse", [False, True])
def test_poses_with_times_are_interpolated_at_the_frames_times(tmp_path: Path, inverse: bool) -> None:
    write_frames(tmp_path, POSES, names=["1.05", "1.10", "1.125", "1.20"])
    at = 1 + 0.02 * np.arange(12)
    poses = np.stack([pose_at(time) for time in at])
    written = np.linalg.inv(poses) if inverse else poses
    (tmp_path / "t.txt").write_text(lines([f"{time:.6f}" for time in at], written))
    options = {"pose_is": "camera_from_world"} if inverse else {}
    recording = read(tmp_path, pose="t.txt", timestamps="name", **options)
    expected = np.stack([pose_at(time) for time in (1.05, 1.1, 1.125, 1.2)])
    assert np.abs(recording.cameras[0].world_from_cameras - expected).max() < 1e-9
    assert "2 of 4 frames have a pose of their own" in recording.assumptions["pose"]


def test_times_without_times_of_frames_are_refused_with_commands_that_work(tmp_path: Path) -> None:
    write_frames(tmp_path, POSES)
    (tmp_path / "t.txt").write_text(lines(["1.60464489e+09"] * 4, POSES))
    with pytest.raises(
        BadData,
        match=r"got times in the lines \(1.60464489e\+09 in all of them: they were written with too few digits\), and "
        "none for frame 000000.  fix: pass --timestamps FILE.* --pose-by order",
    ):
        read(tmp_path, pose="t.txt")
    camera = read(tmp_path, pose="t.txt", pose_by="order").cameras[0]
    assert np.allclose(camera.world_from_cameras, POSES, atol=1e-9)


def test_frames_that_no_pose_is_near_can_be_left_out(tmp_path: Path) -> None:
    write_frames(tmp_path, POSES)
    (tmp_path / "times.txt").write_text("1.0\n1.1\n1.2\n1.3\n")
    (tmp_path / "t.txt").write_text(lines(["1.05", "1.12", "1.19", "1.28"], POSES))
    options = {"pose": "t.txt", "timestamps": "times.txt"}
    with pytest.raises(BadData, match=r"frame 000000: pose: expected poses at most 0.1 s apart around 1.000000 s"):
        read(tmp_path, **options)
    recording = read(tmp_path, **options, skip_bad=True)
    assert recording.cameras[0].time.tolist() == [1.1, 1.2]
    assert recording.assumptions["frames"].startswith("2 of 4; 2 left out")
    (tmp_path / "t.txt").write_text(lines(["11.05", "11.12", "11.19", "11.28"], POSES))
    with pytest.raises(
        BadData, match="time: expected poses around the frames' times, 1.000000 to 1.300000 s, got 11.05"
    ):
        read(tmp_path, **options)


def test_frames_whose_number_no_line_has_can_be_left_out(tmp_path: Path) -> None:
    write_frames(tmp_path, POSES, names=["1", "2", "3", "9"])
    (tmp_path / "t.txt").write_text(lines(["9", "1", "3"], POSES[[3, 0, 2]]))
    (tmp_path / "lost.txt").write_text(lines(["9", "nan", "3"], POSES[[3, 0, 2]]))
    with pytest.raises(BadData, match="none that starts with the number of 1.  fix: pass --skip-bad"):
        read(tmp_path, pose="lost.txt", pose_by="number")
    with pytest.raises(BadData, match="none that starts with the number of 2.  fix: pass --skip-bad"):
        read(tmp_path, pose="t.txt")
    camera = read(tmp_path, pose="t.txt", skip_bad=True).cameras[0]
    assert np.allclose(camera.world_from_cameras, POSES[[0, 2, 3]], atol=1e-9)


def test_poses_with_the_names_of_images_belong_to_these(tmp_path: Path) -> None:
    write_frames(tmp_path, POSES, names=["5", "6", "7", "8"])
    order = [2, 0, 3, 1]
    (tmp_path / "t.txt").write_text(lines([f"frame-{5 + i}.color.png" for i in order], POSES[order]))
    assert np.allclose(read(tmp_path, pose="t.txt").cameras[0].world_from_cameras, POSES, atol=1e-9)


def test_a_log_belongs_to_frames_in_order_even_where_they_are_counted_from_one(tmp_path: Path) -> None:
    write_frames(tmp_path, POSES, names=["1", "2", "3", "4"])
    np.savetxt(tmp_path / "pose.txt", POSES.reshape(16, 4))
    blocks = (tmp_path / "pose.txt").read_text().splitlines()
    log = "\n".join(f"{i} {i} {i + 1}\n" + "\n".join(blocks[4 * i : 4 * i + 4]) for i in range(4))
    (tmp_path / "t.log").write_text(log)
    assert np.allclose(read(tmp_path, pose="t.log").cameras[0].world_from_cameras, POSES, atol=1e-9)


def test_transposed_matrices_are_named_and_read_where_they_are_stated(tmp_path: Path) -> None:
    write_frames(tmp_path, np.swapaxes(POSES, 1, 2))
    with pytest.raises(BadData, match=r"000000.pose.txt: pose: .* transposed: column-major.*fix: pass --column-major"):
        read(tmp_path)
    recording = read(tmp_path, column_major=True)
    assert np.allclose(recording.cameras[0].world_from_cameras, POSES, atol=1e-9)
    write_frames(tmp_path, POSES)
    with pytest.raises(BadData, match="fix: leave out --column-major"):
        read(tmp_path, column_major=True)


def test_other_orders_and_units_are_compared(tmp_path: Path) -> None:
    write_frames(tmp_path, POSES)
    written = POSES.copy()
    written[:, :3, 3] *= 1000
    quat_wxyz = np.roll(Rotation.from_matrix(POSES[:, :3, :3]).as_quat(), 1, axis=1)
    for i, pose in enumerate(written):
        np.savetxt(tmp_path / f"frame-{i:06d}.pose.txt", pose)
    assert np.allclose(source_camera(tmp_path).otherwise["--pose-unit mm"], POSES, atol=1e-9)
    for i, pose in enumerate(POSES):
        np.savetxt(tmp_path / f"frame-{i:06d}.pose.txt", np.r_[pose[:3, 3], quat_wxyz[i]][None])
    readings = source_camera(tmp_path).otherwise
    assert np.allclose(readings["--quat wxyz"], POSES, atol=1e-9)
    assert not any("--pose-unit" in name for name in readings), "cameras a metre apart are not in millimetres"
