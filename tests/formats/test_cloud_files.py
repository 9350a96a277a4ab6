from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bask_data.errors import BadData
from bask_data.formats.recording import PreparedRecording
from tests.formats.clouds import organised, pcd
from tests.formats.folders import HEIGHT, INTRINSICS, WIDTH, K, images, rigid, write_frames, write_image
from tests.formats.test_frames import read


def write_clouds(folder: Path, n: int = 2) -> tuple[np.ndarray, np.ndarray]:
    """Clouds and poses beside colour and depth images of other frames."""
    color, depth = images(n)
    write_frames(folder, np.stack([rigid(np.random.default_rng(i)) for i in range(n)]), seed=7)
    for i in range(n):
        points = organised(depth[i].astype(np.float32) / 1000, color[i], K)
        (folder / f"{i:06d}.pcd").write_bytes(pcd(points, HEIGHT, WIDTH))
    return color, depth


def check(recording: PreparedRecording, depth: np.ndarray) -> None:
    (camera,) = recording.cameras
    assert np.allclose(camera.K, K, atol=1e-3)
    for i in range(2):
        assert np.abs(camera.read(i)[1] * camera.depth_scale - depth[i] / 1000).max() <= camera.depth_scale / 2 + 1e-7


def test_organised_clouds_give_depth_colour_and_intrinsics(tmp_path: Path) -> None:
    color, depth = write_clouds(tmp_path)
    recording = read(tmp_path, cloud="*.pcd", intrinsics="")
    check(recording, depth)
    assert np.array_equal(recording.cameras[0].read(1)[0], color[1])
    assert recording.assumptions["intrinsics"].startswith("20,21,7.5,5.5, fitted to the points of 000000.pcd")
    assert "z of the clouds' points" in recording.assumptions["depth"]


def test_colour_of_files_is_taken_where_it_is_asked_for(tmp_path: Path) -> None:
    _, depth = write_clouds(tmp_path)
    for i in range(2):
        write_image(tmp_path / f"rgb/{i:06d}.png", images(2, seed=9)[0][i])
    recording = read(tmp_path, cloud="*.pcd", color="rgb/*.png", intrinsics=INTRINSICS)
    check(recording, depth)
    assert np.array_equal(recording.cameras[0].read(1)[0], images(2, seed=9)[0][1])


def test_intrinsics_that_the_points_were_not_made_with_are_refused(tmp_path: Path) -> None:
    write_clouds(tmp_path)
    with pytest.raises(BadData, match="expected those that the points were made with, 20,21,7.5,5.5, got others"):
        read(tmp_path, cloud="*.pcd", intrinsics="30,30,7.5,5.5")


def test_a_cloud_in_the_frame_of_the_world_is_refused(tmp_path: Path) -> None:
    color, depth = write_clouds(tmp_path)
    points = organised(depth[0].astype(np.float32) / 1000, color[0], K)
    points["x"], points["z"] = points["z"] + 2, 3 - points["x"]
    (tmp_path / "000000.pcd").write_bytes(pcd(points, HEIGHT, WIDTH))
    with pytest.raises(BadData, match="expected points that a pinhole camera sees at their pixels, z forward"):
        read(tmp_path, cloud="*.pcd", intrinsics="")


def test_a_list_of_points_is_refused(tmp_path: Path) -> None:
    color, depth = write_clouds(tmp_path)
    points = organised(depth[0].astype(np.float32) / 1000, color[0], K)
    (tmp_path / "000000.pcd").write_bytes(pcd(points, 1, len(points)))
    with pytest.raises(BadData, match="expected an organised cloud with x, y and z, of HEIGHT above 1, got 192 x 1"):
        read(tmp_path, cloud="*.pcd", intrinsics="")
