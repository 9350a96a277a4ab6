from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bask_data.errors import BadData, UsageError
from bask_data.formats import intrinsics
from bask_data.formats.files import Folder
from bask_data.formats.poses import OPENCV_FROM_OPENGL

VGA = (480, 640)
HERE = Folder(Path())


@pytest.mark.parametrize(
    "text",
    ["600 601 320 240", "600,601,320,240", "600 0 320\n0 601 240\n0 0 1", "600 0 320 0 0 601 240 0 0 0 1 0 0 0 0 1"],
)
def test_intrinsics_read_from_a_file_of_four_nine_or_sixteen_numbers(tmp_path: Path, text: str) -> None:
    (tmp_path / "K.txt").write_text(text)
    expected = np.array([[600, 0, 320], [0, 601, 240], [0, 0, 1.0]])
    for source, given_as in ((tmp_path, "K.txt"), (Path("/"), str(tmp_path / "K.txt"))):
        matrix, files = intrinsics.parse_intrinsics(Folder(source), given_as)
        assert np.array_equal(matrix, expected)
        assert [file.name for file in files] == ["K.txt"]


def test_intrinsics_read_from_the_command_line() -> None:
    matrix, files = intrinsics.parse_intrinsics(HERE, "600,601,320,240")
    assert np.array_equal(matrix, [[600, 0, 320], [0, 601, 240], [0, 0, 1]])
    assert files == ()


def test_missing_intrinsics_are_reported() -> None:
    with pytest.raises(UsageError, match="--intrinsics: expected fx,fy,cx,cy or a file, got nothing"):
        intrinsics.parse_intrinsics(HERE, "")


def test_intrinsics_of_another_count_are_refused(tmp_path: Path) -> None:
    (tmp_path / "K.txt").write_text("600 601 320")
    with pytest.raises(
        BadData, match="intrinsics: expected 4 numbers fx fy cx cy, or a 3x3 or 4x4 matrix, got 3 numbers"
    ):
        intrinsics.parse_intrinsics(Folder(tmp_path), "K.txt")


def test_too_few_numbers_on_the_command_line_are_not_taken_for_a_file(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"--intrinsics: expected 4 numbers fx,fy,cx,cy, got 3\.  fix: "):
        intrinsics.parse_intrinsics(Folder(tmp_path), "150,150,79.5")
    (tmp_path / "K,left.txt").write_text("600 601 320 240")
    assert intrinsics.parse_intrinsics(Folder(tmp_path), "K,left.txt")[0][0, 0] == 600


@pytest.mark.parametrize("text", ["-600,601,320,240", "600,0,320,240", "nan,600,320,240"])
def test_intrinsics_that_are_not_a_pinhole_matrix_are_refused(text: str) -> None:
    with pytest.raises(BadData, match="intrinsics: expected a pinhole matrix"):
        intrinsics.parse_intrinsics(HERE, text)


@pytest.mark.parametrize(
    ("fx", "fy", "camera_from_opencv", "advice"),
    [
        (-500.0, 500.0, OPENCV_FROM_OPENGL, "--axes opengl"),
        (-500.0, -500.0, np.diag([-1.0, -1, 1, 1]), "diag\\(-1, -1, 1, 1\\)"),
    ],
)
def test_the_advice_on_negative_focal_lengths_gives_the_same_pixels(
    fx: float, fy: float, camera_from_opencv: np.ndarray, advice: str
) -> None:
    K = np.array([[fx, 0, 320], [0, fy, 240], [0, 0, 1]])
    with pytest.raises(BadData, match=advice):
        intrinsics.parse_intrinsics(HERE, f"{fx},{fy},320,240")
    corrected = np.array([[abs(fx), 0, 320], [0, abs(fy), 240], [0, 0, 1]])
    point = np.array([0.1, -0.2, 1.5])  # In OpenCV axes, in front of the camera.
    in_file = (camera_from_opencv @ [*point, 1])[:3]
    np.testing.assert_allclose((K @ in_file)[:2] / in_file[2], (corrected @ point)[:2] / point[2])


def test_intrinsics_of_the_stated_size_must_be_the_images_size() -> None:
    matrix, _ = intrinsics.parse_intrinsics(HERE, "906,905,625,355")
    with pytest.raises(BadData, match="intrinsics: expected images of 1280x720, got 640x480.  fix: scale"):
        intrinsics.check_intrinsics(Path("c.png"), matrix, VGA, "1280x720")


@pytest.mark.parametrize("text", ["906,905,625,355", "306,306,150,120", "600,600,320,900"])
def test_intrinsics_of_another_resolution_are_detected_by_the_principal_point(text: str) -> None:
    matrix, _ = intrinsics.parse_intrinsics(HERE, text)
    with pytest.raises(
        BadData, match="expected a principal point near the middle of images of 640x480, got .*--intrinsics-size"
    ):
        intrinsics.check_intrinsics(Path("c.png"), matrix, VGA, "")


def test_a_crop_with_a_stated_size_may_have_its_principal_point_anywhere_inside() -> None:
    matrix, _ = intrinsics.parse_intrinsics(HERE, "600,600,600,20")
    intrinsics.check_intrinsics(Path("c.png"), matrix, VGA, "640x480")
    matrix[0, 2] = 700
    with pytest.raises(BadData, match="expected a principal point inside images of 640x480"):
        intrinsics.check_intrinsics(Path("c.png"), matrix, VGA, "640x480")


def test_focal_lengths_that_differ_much_are_refused() -> None:
    matrix, _ = intrinsics.parse_intrinsics(HERE, "1200,590,320,240")
    with pytest.raises(BadData, match=r"expected fx and fy alike, within a factor of 2, got \(1200, 590\)"):
        intrinsics.check_intrinsics(Path("c.png"), matrix, VGA, "")
    matrix[0, 0] = 1049
    intrinsics.check_intrinsics(Path("c.png"), matrix, VGA, "")


def test_a_focal_length_in_millimetres_is_refused() -> None:
    matrix, _ = intrinsics.parse_intrinsics(HERE, "3.6,3.6,320,240")
    with pytest.raises(BadData, match="expected focal lengths in pixels, 64 to 12800, got"):
        intrinsics.check_intrinsics(Path("c.png"), matrix, VGA, "")
