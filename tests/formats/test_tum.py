from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from bask_data.errors import BadData, UsageError
from bask_data.formats import FORMATS, tum
from bask_data.formats.options.tum import TumOptions
from bask_data.formats.recording import SourceRecording
from tests.formats.folders import INTRINSICS, images, rigid, write_image

POSES = np.stack([rigid(np.random.default_rng(i)) for i in range(4)])
COLOR_TIME = [10.0, 10.1, 10.2, 10.3]


def read(source: Path, **options: object) -> SourceRecording:
    tum_format = next(item for item in FORMATS if item.name == "tum")
    return tum_format.read(source, TumOptions(**{"intrinsics": INTRINSICS, "depth_scale": 0.001, **options}))


def write_sequence(folder: Path, depth_offset: float = 0.005, pose_offset: float = -0.003) -> None:
    color, depth = images(4)
    lines: dict[str, list[str]] = {"rgb": ["# color images"], "depth": ["# depth maps"], "groundtruth": ["# poses"]}
    for i, time in enumerate(COLOR_TIME):
        write_image(folder / f"rgb/{time:.6f}.png", color[i])
        write_image(folder / f"depth/{time + depth_offset:.6f}.png", depth[i])
        lines["rgb"].append(f"{time:.6f} rgb/{time:.6f}.png")
        lines["depth"].append(f"{time + depth_offset:.6f} depth/{time + depth_offset:.6f}.png")
        quat_xyzw = Rotation.from_matrix(POSES[i, :3, :3]).as_quat()
        values = " ".join(f"{value:.9f}" for value in (*POSES[i, :3, 3], *quat_xyzw))
        lines["groundtruth"].append(f"{time + pose_offset:.4f} {values}")
    for name, content in lines.items():
        (folder / f"{name}.txt").write_text("\n".join(content))


def test_a_sequence_is_joined_by_time(tmp_path: Path) -> None:
    write_sequence(tmp_path)
    recording = read(tmp_path)
    (camera,) = recording.cameras
    color, depth = images(4)
    assert camera.time.tolist() == COLOR_TIME
    assert np.allclose(camera.world_from_cameras, POSES, atol=1e-8)
    for i in range(4):
        rgb, raw = camera.read(i)
        assert np.array_equal(rgb, color[i])
        assert np.array_equal(raw, depth[i])
    assert len(recording.files) == 3 + 8
    assert recording.assumptions["frames"].startswith("4 of 4 colour images")


def test_frames_without_depth_or_pose_close_enough_are_left_out_and_counted(tmp_path: Path) -> None:
    write_sequence(tmp_path)
    for name, line in (("depth.txt", 2), ("groundtruth.txt", 4)):
        lines = (tmp_path / name).read_text().splitlines()
        del lines[line]
        (tmp_path / name).write_text("\n".join(lines))
    recording = read(tmp_path)
    assert recording.cameras[0].time.tolist() == [10.0, 10.2]
    assert np.allclose(recording.cameras[0].world_from_cameras, POSES[[0, 2]], atol=1e-8)
    assert recording.assumptions["frames"].startswith("2 of 4 colour images")


def test_a_sequence_without_any_frame_in_time_is_refused(tmp_path: Path) -> None:
    write_sequence(tmp_path, pose_offset=100.0)
    with pytest.raises(
        BadData, match="timestamps: expected colour, depth and pose within 0.02 s, got none of 4 colour images"
    ):
        read(tmp_path)


times = st.lists(st.integers(0, 1000), min_size=1, max_size=30, unique=True).map(
    lambda v: np.sort(np.array(v, dtype=float))
)


@given(times, times, st.integers(0, 50))
def test_the_nearest_time_agrees_with_a_full_search(time: np.ndarray, other: np.ndarray, limit: int) -> None:
    gap = np.abs(time[:, None] - other[None])
    index = tum.nearest(time, other, float(limit))
    assert np.array_equal(index >= 0, gap.min(axis=1) <= limit)
    kept = index >= 0
    assert np.array_equal(gap[np.arange(len(time)), index][kept], gap.min(axis=1)[kept])


@given(times, times, st.integers(0, 50))
def test_no_depth_image_is_used_twice(time: np.ndarray, other: np.ndarray, limit: int) -> None:
    index = tum.mutual_nearest(time, other, float(limit))
    used = index[index >= 0]
    assert len(set(used.tolist())) == len(used)
    assert (np.abs(other[used] - time[index >= 0]) <= limit).all()


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
        match="rgb.txt: timestamps: expected finite times that increase from line to line, got 10.2 s in data line 2",
    ):
        read(tmp_path)
    (tmp_path / "rgb.txt").write_text(good.replace("rgb/10.0", "../rgb/10.0"))
    with pytest.raises(BadData, match="expected a path inside the source folder"):
        read(tmp_path)
    (tmp_path / "rgb.txt").write_text(good)
    (tmp_path / "groundtruth.txt").write_text("10.0 1 2 3")
    with pytest.raises(BadData, match="groundtruth.txt: lines: expected `timestamp tx ty tz qx qy qz qw` in each"):
        read(tmp_path)


def test_an_invalid_pose_is_named_by_its_time(tmp_path: Path) -> None:
    write_sequence(tmp_path)
    text = (tmp_path / "groundtruth.txt").read_text().splitlines()
    text[1] = "9.997 0 0 0 0 0 0 2"
    (tmp_path / "groundtruth.txt").write_text("\n".join(text))
    with pytest.raises(
        BadData, match="groundtruth.txt: time 9.997000: pose: expected a quaternion of length 1, got length 2"
    ):
        read(tmp_path)
