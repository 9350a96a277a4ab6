from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import open3d as o3d
import pytest
import yaml
from scipy.spatial.transform import Rotation

from bask_data.errors import BadData
from bask_data.formats.files import Folder
from bask_data.formats.intrinsics import CameraIntrinsics, parse_intrinsics, read_calibration

K = np.array([[600.0, 0, 320], [0, 601, 240], [0, 0, 1]])
D = [-0.28, 0.09, 0.001, -0.002, 0.01]
FOUR = {"fx": 600, "fy": 601, "cx": 320, "cy": 240}
LISTS_OF_LISTS = "".join(
    f"{name}: &{name} [{', '.join(['1'] * 9 if last == '-' else [f'*{last}'] * 9)}]\n"
    for last, name in pairwise("-abcdefghijk")
)
"""YAML of half a kilobyte whose last list, k, stands for 9^11 numbers."""
ROS = {
    "image_width": 640,
    "image_height": 480,
    "camera_matrix": {"rows": 3, "cols": 3, "data": K.ravel().tolist()},
    "distortion_model": "plumb_bob",
    "distortion_coefficients": {"rows": 1, "cols": 5, "data": D},
}


def held(folder: Path, content: object, suffix: str = ".json") -> CameraIntrinsics:
    text = content if isinstance(content, str) else json.dumps(content)
    (folder / f"c{suffix}").write_text(text)
    return read_calibration(Folder(folder), f"c{suffix}")


def test_a_file_of_opencv_is_read(tmp_path: Path) -> None:
    for name in ("camera_matrix", "K"):
        storage = cv2.FileStorage(str(tmp_path / "c.yml"), cv2.FILE_STORAGE_WRITE)
        storage.write(name, K)
        storage.write("dist_coeffs", np.array([D]))
        storage.release()
        calibration = read_calibration(Folder(tmp_path), "c.yml")
        assert np.array_equal(calibration.K, K)
        assert calibration.distortion is not None and calibration.distortion.parameters == tuple(D)


def test_a_file_of_open3d_is_read_although_its_matrix_is_column_major(tmp_path: Path) -> None:
    file = tmp_path / "c.json"
    o3d.io.write_pinhole_camera_intrinsic(str(file), o3d.camera.PinholeCameraIntrinsic(640, 480, 600, 601, 320, 240))
    calibration = read_calibration(Folder(tmp_path), "c.json")
    assert np.array_equal(calibration.K, K)
    assert (calibration.size, calibration.distortion) == ("640x480", None)


@pytest.mark.parametrize(
    "content",
    [
        FOUR,
        {"camera": {**FOUR, "w": 640, "h": 480}},
        {"color": FOUR, "depth": {**FOUR, "fx": 500}},
        {"ppx": 320, "ppy": 240, "fx": 600, "fy": 601, "model": "distortion.inverse_brown_conrady", "coeffs": [0] * 5},
        {"camera_matrix": K.tolist(), "dist_coeffs": [[0, 0, 0, 0, 0]]},
        {"K": K.ravel().tolist(), "D": [], "width": 640, "height": 480},
        {"fl_x": 600, "fl_y": 601, "cx": 320, "cy": 240, "k1": 0},
    ],
)
def test_intrinsics_are_found_by_their_usual_names(tmp_path: Path, content: object) -> None:
    for suffix, text in ((".json", json.dumps(content)), (".yaml", yaml.safe_dump(content))):
        calibration = held(tmp_path, text, suffix)
        assert np.array_equal(calibration.K, K) and calibration.distortion is None


def test_a_camera_info_of_ros_has_its_lens_and_size(tmp_path: Path) -> None:
    calibration = held(tmp_path, yaml.safe_dump(ROS), ".yaml")
    assert calibration.size == "640x480"
    assert calibration.distortion is not None
    assert (calibration.distortion.name, calibration.distortion.parameters) == ("OPENCV", tuple(D))
    fisheye = held(tmp_path, {**ROS, "distortion_model": "equidistant", "distortion_coefficients": D[:4]})
    assert fisheye.distortion is not None and fisheye.distortion.name == "OPENCV_FISHEYE"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"left": FOUR, "right": FOUR}, "expected those of one camera.* got those of left, right"),
        ({"note": "none"}, "expected those of one camera.* got none"),
        ("{broken", "expected JSON or YAML"),
        ("[" * 100_000, "expected JSON or YAML|expected those of one camera"),
        ({**ROS, "distortion_model": "woodscape"}, "lens: expected a known lens model, got .*'WOODSCAPE'"),
        ({**ROS, "camera_matrix": [[1, 2, 3]] * 3}, "expected a pinhole matrix"),
        ({**ROS, "camera_matrix": [[1, 2], [3, 4]]}, "expected those of one camera.* got none"),
        ("!!python/object/apply:os.system ['true']", "expected JSON or YAML"),
        (LISTS_OF_LISTS, "expected those of one camera.* got none"),
        ({**FOUR, "fx": 10**400}, "expected those of one camera.* got none"),
    ],
)
def test_what_is_no_calibration_of_one_camera_is_refused(tmp_path: Path, content: object, message: str) -> None:
    suffix = ".json" if not isinstance(content, str) or content.startswith("{") else ".yaml"
    with pytest.raises(BadData, match=message):
        held(tmp_path, content, suffix)


@pytest.mark.parametrize(
    ("numbers", "n_distortion"),
    [
        ([600, 601, 320, 240, *D], 5),
        ([600, 601, 320, 240, *D[:4]], 4),
        ([*K.ravel(), *D], 5),
        ([600, 601, 320, 240, *D, 0.1, 0.2, 0.3], 8),
        ([*K.ravel(), *D[:4]], 4),
        ([*K[0], 0, *K[1], 0, *K[2], 0], 0),
        (list(K.T.ravel()), 0),
    ],
)
def test_distortion_after_the_intrinsics_is_read_and_stated(
    tmp_path: Path, numbers: list[float], n_distortion: int
) -> None:
    calibration = held(tmp_path, " ".join(f"{value}" for value in numbers), ".txt")
    assert np.array_equal(calibration.K, K)
    parameters = calibration.distortion.parameters if calibration.distortion else ()
    assert len(parameters) == n_distortion and np.allclose(parameters, numbers[len(numbers) - n_distortion :])
    assert ("OPENCV lens distortion (-0.28, 0.09" in calibration.statement) == (n_distortion > 0)
    if n_distortion:
        with pytest.raises(BadData, match="expected no lens distortion here, got OPENCV"):
            parse_intrinsics(Folder(tmp_path), "c.txt")


def test_other_numbers_after_the_intrinsics_are_refused(tmp_path: Path) -> None:
    with pytest.raises(BadData, match="expected distortion below 100 after 4 numbers of the intrinsics, got .*640"):
        held(tmp_path, "600 601 320 240 640 480 0 0", ".txt")


def test_a_negative_fy_is_explained_by_what_gives_the_same_pixels(tmp_path: Path) -> None:
    with pytest.raises(
        BadData, match=r"y points up here.*\(ICL-NUIM\).*make fy positive, and change the signs of ty, qx"
    ):
        held(tmp_path, "481.2 0 319.5 0 -480 239.5 0 0 1", ".txt")
    rng = np.random.default_rng(0)
    values = np.r_[rng.normal(size=3), Rotation.random(random_state=0).as_quat()]
    mirrored = values * [1, -1, 1, -1, 1, -1, 1]
    # The same point of the room, in the mirrored world, is at the same pixel and depth.
    point, flip = rng.normal(size=3), np.diag([1.0, -1, 1])
    seen, seen_mirrored = (
        np.linalg.inv(Rotation.from_quat(v[3:]).as_matrix()) @ (p - v[:3])
        for v, p in ((values, point), (mirrored, flip @ point))
    )
    K_up = np.array([[481.2, 0, 319.5], [0, -480, 239.5], [0, 0, 1]])
    assert np.allclose(K_up @ seen, np.abs(K_up) @ seen_mirrored)
