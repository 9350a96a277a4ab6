from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import open3d as o3d
import pytest
from scipy.spatial.transform import Rotation

from bask_data.errors import BadData
from bask_data.formats.trajectory_files import PoseLayout, Trajectory, read_trajectory
from tests.formats.folders import rigid

POSES = np.stack([rigid(np.random.default_rng(i)) for i in range(6)])


def rows(matrix: np.ndarray) -> str:
    return "\n".join(" ".join(f"{value:.17g}" for value in row) for row in matrix)


def quaternions(order: str = "xyzw") -> np.ndarray:
    quat_xyzw = Rotation.from_matrix(POSES[:, :3, :3]).as_quat()
    return np.c_[POSES[:, :3, 3], quat_xyzw if order == "xyzw" else np.roll(quat_xyzw, 1, axis=1)]


def held(file: Path, content: str, **layout: object) -> Trajectory:
    file.write_text(content)
    return read_trajectory(file, PoseLayout(**layout))


FORMS = {
    "a matrix of 4x4 per line": rows(POSES.reshape(6, 16)),
    "a matrix of 3x4 per line": rows(POSES[:, :3].reshape(6, 12)),
    "a quaternion per line": rows(quaternions()),
    "with commas": rows(quaternions()).replace(" ", ","),
    "with semicolons": rows(quaternions()).replace(" ", "; "),
    "blocks of four lines": "\n\n".join(rows(pose) for pose in POSES),
    "blocks of three lines": "\n".join(rows(pose[:3]) for pose in POSES),
    "blocks as JSON is printed": json.dumps(POSES.tolist(), indent=1).replace(",\n   ", ", "),
    "blocks as NumPy prints them": "\n".join(str(pose.tolist()).replace("], [", "],\n [") for pose in POSES),
}


@pytest.mark.parametrize("form", FORMS)
def test_poses_read_the_same_in_every_form(tmp_path: Path, form: str) -> None:
    trajectory = held(tmp_path / "t.txt", "# remark\n" + FORMS[form])
    assert np.allclose(trajectory.poses, POSES, atol=1e-12)
    assert trajectory.keys == ()
    assert trajectory.place(0).endswith(f"t.txt: line {5 if 'JSON' in form else 2}")


def test_a_log_of_open3d_is_read(tmp_path: Path) -> None:
    parameters = []
    for pose in POSES:
        camera = o3d.camera.PinholeCameraParameters()
        camera.extrinsic = np.linalg.inv(pose)
        camera.intrinsic = o3d.camera.PinholeCameraIntrinsic(16, 12, 20, 20, 7.5, 5.5)
        parameters.append(camera)
    trajectory = o3d.camera.PinholeCameraTrajectory()
    trajectory.parameters = parameters
    file = tmp_path / "t.log"
    assert o3d.io.write_pinhole_camera_trajectory(str(file), trajectory)
    read = read_trajectory(file, PoseLayout())
    assert np.allclose(read.poses, POSES, atol=1e-7)
    assert read.keys == tuple(str(i) for i in range(6)) and read.in_blocks


@pytest.mark.parametrize("shape", [(6, 4, 4), (6, 16), (6, 3, 4), (6, 7)])
def test_arrays_of_numpy_are_read(tmp_path: Path, shape: tuple[int, ...]) -> None:
    values = {4: POSES, 3: POSES[:, :3], 7: quaternions(), 16: POSES}[shape[1]]
    np.save(tmp_path / "t.npy", values.reshape(shape))
    assert np.allclose(read_trajectory(tmp_path / "t.npy", PoseLayout()).poses, POSES, atol=1e-12)


def test_an_array_of_another_shape_is_refused(tmp_path: Path) -> None:
    np.save(tmp_path / "t.npy", np.zeros((6, 5)))
    with pytest.raises(
        BadData, match=r"expected an array \(t, 4, 4\), \(t, 3, 4\) or \(t, 7\) of numbers, got \(6, 5\)"
    ):
        read_trajectory(tmp_path / "t.npy", PoseLayout())


def test_numbers_and_times_before_poses_keep_all_their_digits(tmp_path: Path) -> None:
    stamps = [1604644894033333333 + i for i in range(6)]
    lines = rows(quaternions()).splitlines()
    text = "\n".join(f"{stamp} {line}" for stamp, line in zip(stamps, lines, strict=True))
    trajectory = held(tmp_path / "t.txt", text)
    assert trajectory.stamps.tolist() == stamps
    assert trajectory.quaternions and np.allclose(trajectory.poses, POSES, atol=1e-12)


def test_column_major_matrices_and_other_quaternions_are_read_where_they_are_stated(tmp_path: Path) -> None:
    for matrices in (POSES, POSES[:, :3]):
        text = rows(np.swapaxes(matrices, 1, 2).reshape(6, -1))
        assert np.allclose(held(tmp_path / "t.txt", text, column_major=True).poses, POSES, atol=1e-12)
    text = rows(quaternions("wxyz"))
    assert np.allclose(held(tmp_path / "t.txt", text, quat="wxyz").poses, POSES, atol=1e-12)


@pytest.mark.parametrize("separator", [" ", ",", ", "])
def test_a_header_is_skipped_and_names_of_images_are_keys(tmp_path: Path, separator: str) -> None:
    lines = [line.replace(" ", separator) for line in rows(quaternions()).splitlines()]
    text = "\n".join(f"rgb/img_{i:03d}.png{separator}{line}" for i, line in enumerate(lines, 7))
    header = separator.join(["image", "tx", "ty", "tz", "qx", "qy", "qz", "qw"])
    trajectory = held(tmp_path / "t.csv", f"{header}\n{text}")
    assert np.allclose(trajectory.poses, POSES, atol=1e-12)
    assert trajectory.keys[1] == "rgb/img_008.png" and trajectory.numbers == list(range(7, 13))
    assert trajectory.lines[0] == 2 and trajectory.quaternions
    with pytest.raises(BadData, match="time: expected lines that begin with times"):
        _ = trajectory.stamps
    timed = held(tmp_path / "t.csv", "\n".join([header, *(f"{i}.5{separator}{line}" for i, line in enumerate(lines))]))
    assert timed.stamps.tolist() == [0.5, 1.5, 2.5, 3.5, 4.5, 5.5] and timed.numbers == [None] * 6


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1 2 3 4 5", "pose: expected lines of 7, 12 or 16 numbers"),
        ("0 0 0 0 0 0 1\n0 0 0\n", "got 3 numbers in line 2, 7 in the first"),
        ("1 0 0 0\n0 1 0 0", "expected blocks of 4 lines of 4 numbers"),
        ("", "expected some bytes, got an empty file"),
        ("# nothing", "got no lines"),
        ("0,5 0,25 1 0 0 0 1", "expected numbers with decimal points, got decimal commas"),
    ],
)
def test_a_file_of_something_else_is_refused(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(BadData, match=message):
        held(tmp_path / "t.txt", text)
