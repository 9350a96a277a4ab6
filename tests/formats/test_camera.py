from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from bask_data.errors import BadData, UsageError
from bask_data.formats import camera
from bask_data.formats.images import ImageHeader
from tests.formats.folders import K, images, rigid, write_image

VGA = ImageHeader(480, 640, 8, 3)


@given(st.integers(0, 10**6))
def test_a_pose_reads_the_same_as_matrix_of_four_or_three_rows_and_as_quaternion(seed: int) -> None:
    matrix = rigid(np.random.default_rng(seed))
    quat_xyzw = Rotation.from_matrix(matrix[:3, :3]).as_quat()
    for values in (matrix.ravel(), matrix[:3].ravel(), np.r_[matrix[:3, 3], quat_xyzw]):
        assert np.allclose(camera.parse_pose("pose.txt", values.tolist()), matrix, atol=1e-12)


@given(st.integers(0, 10**6))
def test_rounded_poses_are_made_exactly_rigid(seed: int) -> None:
    rounded = np.round(rigid(np.random.default_rng(seed)), 4)
    rotation = camera.parse_pose("pose.txt", rounded.ravel().tolist())[:3, :3]
    assert np.allclose(rotation.T @ rotation, np.eye(3), atol=1e-14)


FAULTS = {
    "a mirrored frame": np.diag([1.0, 1, -1, 1]),
    "a scaled frame": np.diag([2.0, 2, 2, 1]),
    "a value that is not finite": np.diag([1.0, 1, np.nan, 1]),
    "axes that are not perpendicular": np.array([[1, 0.8, 0, 0], [0, 0.6, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]]),
    "last row": np.eye(4).T + np.diag([0, 0, 0, 1.0]),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_pose_that_is_not_rigid_is_refused_with_its_fault(fault: str) -> None:
    with pytest.raises(BadData, match=f"pose.txt: pose: expected a rigid transform, got {fault}.*fix: "):
        camera.parse_pose("pose.txt", FAULTS[fault].ravel().tolist())


def test_a_pose_of_another_count_of_numbers_is_refused() -> None:
    with pytest.raises(BadData, match="pose: expected a 4x4 or 3x4 matrix or tx ty tz qx qy qz qw, got 6 numbers"):
        camera.parse_pose("pose.txt", [0.0] * 6)


@pytest.mark.parametrize("quaternion", [[0.0, 0.0, 0.0, 0.0], [1.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, float("nan")]])
def test_a_quaternion_without_unit_length_is_refused(quaternion: list[float]) -> None:
    with pytest.raises(BadData, match="expected a quaternion of length 1, got length"):
        camera.parse_pose("pose.txt", [0.0, 0.0, 0.0, *quaternion])


def test_all_invalid_poses_are_listed_in_one_message(tmp_path: Path) -> None:
    for i in range(4):
        (tmp_path / f"{i}.txt").write_text("nan " * 16 if i else "1 0 0 0 0 1 0 0 0 0 1 0")
    with pytest.raises(BadData, match="1.txt: pose: expected a rigid transform") as error:
        camera.read_poses([tmp_path / f"{i}.txt" for i in range(4)])
    assert error.value.__notes__ == ["also: 2.txt, 3.txt"]


@pytest.mark.parametrize(
    "text",
    ["600 601 320 240", "600,601,320,240", "600 0 320\n0 601 240\n0 0 1", "600 0 320 0 0 601 240 0 0 0 1 0 0 0 0 1"],
)
def test_intrinsics_read_from_a_file_of_four_nine_or_sixteen_numbers(tmp_path: Path, text: str) -> None:
    (tmp_path / "K.txt").write_text(text)
    expected = np.array([[600, 0, 320], [0, 601, 240], [0, 0, 1.0]])
    for source, given_as in ((tmp_path, "K.txt"), (Path("/"), str(tmp_path / "K.txt"))):
        matrix, files = camera.parse_intrinsics(source, given_as)
        assert np.array_equal(matrix, expected)
        assert [file.name for file in files] == ["K.txt"]


def test_intrinsics_read_from_the_command_line() -> None:
    matrix, files = camera.parse_intrinsics(Path(), "600,601,320,240")
    assert np.array_equal(matrix, [[600, 0, 320], [0, 601, 240], [0, 0, 1]])
    assert files == ()


def test_missing_intrinsics_are_reported() -> None:
    with pytest.raises(UsageError, match="--intrinsics: expected fx,fy,cx,cy or a file, got nothing"):
        camera.parse_intrinsics(Path(), "")


def test_intrinsics_of_another_count_are_refused(tmp_path: Path) -> None:
    (tmp_path / "K.txt").write_text("600 601 320")
    with pytest.raises(
        BadData, match="intrinsics: expected 4 numbers fx fy cx cy, or a 3x3 or 4x4 matrix, got 3 numbers"
    ):
        camera.parse_intrinsics(tmp_path, "K.txt")


def test_too_few_numbers_on_the_command_line_are_not_taken_for_a_file(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"--intrinsics: expected 4 numbers fx,fy,cx,cy, got 3\.  fix: "):
        camera.parse_intrinsics(tmp_path, "150,150,79.5")
    (tmp_path / "K,left.txt").write_text("600 601 320 240")
    assert camera.parse_intrinsics(tmp_path, "K,left.txt")[0][0, 0] == 600


@pytest.mark.parametrize("text", ["-600,601,320,240", "600,0,320,240", "nan,600,320,240"])
def test_intrinsics_that_are_not_a_pinhole_matrix_are_refused(text: str) -> None:
    with pytest.raises(BadData, match="intrinsics: expected a pinhole matrix"):
        camera.parse_intrinsics(Path(), text)


@pytest.mark.parametrize(
    ("fx", "fy", "camera_from_opencv", "advice"),
    [
        (-500.0, 500.0, camera.OPENCV_FROM_OPENGL, "--axes opengl"),
        (-500.0, -500.0, np.diag([-1.0, -1, 1, 1]), "diag\\(-1, -1, 1, 1\\)"),
    ],
)
def test_the_advice_on_negative_focal_lengths_gives_the_same_pixels(
    fx: float, fy: float, camera_from_opencv: np.ndarray, advice: str
) -> None:
    K = np.array([[fx, 0, 320], [0, fy, 240], [0, 0, 1]])
    with pytest.raises(BadData, match=advice):
        camera.parse_intrinsics(Path(), f"{fx},{fy},320,240")
    corrected = np.array([[abs(fx), 0, 320], [0, abs(fy), 240], [0, 0, 1]])
    point = np.array([0.1, -0.2, 1.5])  # In OpenCV axes, in front of the camera.
    in_file = (camera_from_opencv @ [*point, 1])[:3]
    np.testing.assert_allclose((K @ in_file)[:2] / in_file[2], (corrected @ point)[:2] / point[2])


def test_intrinsics_of_the_stated_size_must_be_the_images_size() -> None:
    matrix, _ = camera.parse_intrinsics(Path(), "906,905,625,355")
    with pytest.raises(BadData, match="intrinsics: expected images of 1280x720, got 640x480.  fix: scale"):
        camera.check_intrinsics(Path("c.png"), matrix, VGA, "1280x720")


@pytest.mark.parametrize("text", ["906,905,625,355", "306,306,150,120", "600,600,320,900"])
def test_intrinsics_of_another_resolution_are_detected_by_the_principal_point(text: str) -> None:
    matrix, _ = camera.parse_intrinsics(Path(), text)
    with pytest.raises(
        BadData, match="expected a principal point near the middle of images of 640x480, got .*--intrinsics-size"
    ):
        camera.check_intrinsics(Path("c.png"), matrix, VGA, "")


def test_a_crop_with_a_stated_size_may_have_its_principal_point_anywhere_inside() -> None:
    matrix, _ = camera.parse_intrinsics(Path(), "600,600,600,20")
    camera.check_intrinsics(Path("c.png"), matrix, VGA, "640x480")
    matrix[0, 2] = 700
    with pytest.raises(BadData, match="expected a principal point inside images of 640x480"):
        camera.check_intrinsics(Path("c.png"), matrix, VGA, "640x480")


def test_a_focal_length_in_millimetres_is_refused() -> None:
    matrix, _ = camera.parse_intrinsics(Path(), "3.6,3.6,320,240")
    with pytest.raises(BadData, match="expected focal lengths in pixels, 64 to 12800, got"):
        camera.check_intrinsics(Path("c.png"), matrix, VGA, "")


def image_files(folder: Path, depth: np.ndarray, color: np.ndarray) -> camera.ImageFiles:
    paths: dict[str, list[Path]] = {"c": [], "d": []}
    for i in range(len(depth)):
        for kind, image in (("c", color[i]), ("d", depth[i])):
            write_image(folder / f"{kind}{i}.png", image)
            paths[kind].append(folder / f"{kind}{i}.png")
    return camera.ImageFiles(tuple(paths["c"]), tuple(paths["d"]))


def read_camera(files: camera.ImageFiles, scale: float = 0.001, time: list[float] | None = None) -> None:
    n = len(files.color)
    poses = np.broadcast_to(np.eye(4), (n, 4, 4)).copy()
    camera.camera_recording("c", files, K, "", scale, poses, np.array(time or range(n), dtype=float))


def test_an_image_of_another_size_is_named(tmp_path: Path) -> None:
    color, depth = images(2)
    files = image_files(tmp_path, depth, color)
    write_image(tmp_path / "d1.png", np.ones((24, 32), np.uint16))
    with pytest.raises(
        BadData, match="d1.png: size: expected 16 x 12 as in c0.png, got 32 x 24.  fix: export depth registered"
    ):
        read_camera(files)


@pytest.mark.parametrize("time", [[0.0, 0.0], [1.0, 0.5], [0.0, float("nan")]])
def test_time_that_does_not_increase_is_refused(tmp_path: Path, time: list[float]) -> None:
    color, depth = images(2)
    with pytest.raises(BadData, match="c1.png: time: expected finite times that increase with the frames"):
        read_camera(image_files(tmp_path, depth, color), time=time)


def test_depth_that_is_invalid_everywhere_is_refused_but_not_in_a_single_frame(tmp_path: Path) -> None:
    color, depth = images(3)
    depth[0] = 0
    read_camera(image_files(tmp_path, depth, color))
    with pytest.raises(BadData, match="depth: expected a measurement somewhere in the recording, got none in 3 frames"):
        read_camera(image_files(tmp_path, depth * 0, color))


@pytest.mark.parametrize("scale", [1.0, 1e-7])
def test_an_implausible_depth_scale_is_refused(tmp_path: Path, scale: float) -> None:
    color, depth = images(1)
    with pytest.raises(BadData, match=r"depth: expected a median between 0.001 and 100 m, got .* m at .*--depth-scale"):
        read_camera(image_files(tmp_path, depth, color), scale=scale)
