from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bask_data.errors import BadData
from bask_data.formats import FORMATS
from bask_data.formats.options.stray import StrayOptions
from bask_data.formats.recording import CameraRecording, PreparedRecording
from tests.formats.folders import images, rigid, write_image
from tests.formats.videos import plain, write_video

SIZE = (48, 64)
POSES = np.stack([rigid(np.random.default_rng(i)) for i in range(6)])
K = np.array([[80.0, 0, 31], [0, 81, 24], [0, 0, 1]])
HEADER = "timestamp, frame, x, y, z, qx, qy, qz, qw"
GREY = 40
"""Brightness of frame 0; the others are GREY / 2 brighter each."""


def read(source: Path, **options: object) -> PreparedRecording:
    [format] = [item for item in FORMATS if item.name == "stray"]
    return format.read(source, StrayOptions(**{"trust": True, **options}))


def camera_of(source: Path, **options: object) -> CameraRecording:
    [camera] = read(source, **options).cameras
    return camera


def row(i: int, rest: str = "") -> str:
    quat_xyzw = Rotation.from_matrix(POSES[i, :3, :3]).as_quat()
    values = ", ".join(f"{value:.9f}" for value in (*POSES[i, :3, 3], *quat_xyzw))
    return f"{170340.5 + i / 60:.9f}, {i:06d}, {values}{rest}"


def write_odometry(folder: Path, rows: list[str], header: str = HEADER) -> None:
    (folder / "odometry.csv").write_text("\n".join([header, *rows]) + "\n")


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """Six frames as the app writes them; depth is a quarter of the video's size."""
    folder = tmp_path / "71de12f9"
    depth = images(6)[1]
    confidence = np.random.default_rng(1).integers(0, 3, depth[0].shape, dtype=np.uint8)
    for i in range(6):
        write_image(folder / f"depth/{i:06d}.png", depth[i])
        write_image(folder / f"confidence/{i:06d}.png", confidence)
    np.savetxt(folder / "camera_matrix.csv", K, delimiter=", ")
    write_odometry(folder, [row(i) for i in range(6)])
    write_frames(folder)
    return folder


def write_frames(folder: Path, n: int = 6, first: int = 0, rotation: float = -90.0) -> None:
    """A video whose first picture players hide if `first` is -1."""
    grey = (plain(GREY + GREY // 2 * i, SIZE) for i in range(n))
    write_video(folder / "rgb.mp4", grey, rate=60, first=first, rotation=rotation, options={"bf": "0", "crf": "8"})


def brightness(camera: CameraRecording) -> list[float]:
    """In numbers of frames."""
    return [round(float(camera.read(i)[0].mean() - GREY) / (GREY // 2)) for i in range(camera.n_frames)]


def test_rows_are_joined_with_the_frames_and_images_of_their_number(recording: Path) -> None:
    read_recording = read(recording)
    [camera] = read_recording.cameras
    assert np.allclose(camera.world_from_cameras, POSES, atol=1e-8)
    assert np.allclose(camera.time, 170340.5 + np.arange(6) / 60)
    assert np.allclose(camera.K, np.diag([0.25, 0.25, 1]) @ K)
    assert brightness(camera) == [0, 1, 2, 3, 4, 5]
    for i in range(6):
        assert np.array_equal(camera.read(i)[1], images(6)[1][i])
    assert len(read_recording.files) == 3 + 12


def test_the_picture_is_taken_as_it_is_stored_whatever_its_rotation(recording: Path) -> None:
    image = plain(0, SIZE)
    image[:, :32] = 200
    write_video(recording / "rgb.mp4", [image] * 6, rotation=-90, options={"bf": "0", "crf": "1"})
    rgb, depth = camera_of(recording).read(0)
    assert rgb.shape[:2] == depth.shape == (12, 16)
    assert rgb[:, :7].mean() > 190
    assert rgb[:, 9:].mean() < 10


def test_the_picture_that_players_hide_is_that_of_the_first_row(recording: Path) -> None:
    write_frames(recording, first=-1)
    assert brightness(camera_of(recording)) == [0, 1, 2, 3, 4, 5]
    # If players show as many as there are rows, these are meant.
    write_frames(recording, n=7, first=-1)
    assert brightness(camera_of(recording)) == [1, 2, 3, 4, 5, 6]


def test_newer_tables_state_the_intrinsics_of_each_frame(recording: Path) -> None:
    header = f"{HEADER}, fx, fy, cx, cy, distortion_center_x, distortion_center_y"
    write_odometry(recording, [row(i, f", {80 + i}, 81, 31, {24 - i / 10}, , ") for i in range(6)], header)
    camera = camera_of(recording)
    assert np.allclose(camera.Ks[:, 0, 0], (80 + np.arange(6)) / 4)
    assert np.allclose(camera.Ks[:, 1, 2], (24 - np.arange(6) / 10) / 4)
    (recording / "camera_matrix.csv").unlink()
    assert camera_of(recording).n_frames == 6


def test_rows_without_depth_or_video_are_refused_or_left_out(recording: Path) -> None:
    (recording / "depth/000002.png").unlink()
    write_frames(recording, n=5)
    with pytest.raises(
        BadData, match=r"frame 000002: expected a depth image .* got no depth image.*--skip-bad"
    ) as raised:
        read(recording)
    assert "000005 (incomplete)" in "\n".join(raised.value.__notes__)
    left = read(recording, skip_bad=True)
    assert np.allclose(left.cameras[0].world_from_cameras, POSES[[0, 1, 3, 4]], atol=1e-8)
    assert brightness(left.cameras[0]) == [0, 1, 3, 4]
    assert left.left_out["camera/000005"].endswith("got no frame in rgb.mp4.")


def test_frames_without_a_row_are_counted(recording: Path) -> None:
    write_odometry(recording, [row(i) for i in (0, 1, 3)])
    read_recording = read(recording)
    assert brightness(read_recording.cameras[0]) == [0, 1, 3]
    assert read_recording.assumptions["video"].startswith("6 frames, 3 of them without a row in odometry.csv left out")


def test_a_lost_pose_is_refused_or_left_out(recording: Path) -> None:
    lost = ", ".join(["170340.516666667", "000001", *["nan"] * 7])
    write_odometry(recording, [row(0), lost, *[row(i) for i in range(2, 6)]])
    with pytest.raises(BadData, match=r"odometry\.csv: frame 000001: pose: expected a rigid transform.*--skip-bad"):
        read(recording)
    assert camera_of(recording, skip_bad=True).n_frames == 5


def test_little_confidence_is_left_out_on_demand(recording: Path) -> None:
    kept = camera_of(recording, confidence=2).read(3)[1] > 0
    confidence = np.random.default_rng(1).integers(0, 3, kept.shape, dtype=np.uint8)
    assert np.array_equal(kept, (images(6)[1][3] > 0) & (confidence == 2))
    (recording / "confidence/000003.png").unlink()
    with pytest.raises(BadData, match=r"000003\.png: confidence: expected an image for every frame, got none"):
        camera_of(recording, confidence=2).read(3)
    shutil.rmtree(recording / "confidence")
    assert camera_of(recording).n_frames == 6


def test_depth_of_old_versions_is_an_array_in_millimetres(recording: Path) -> None:
    for i, depth in enumerate(images(6)[1]):
        (recording / f"depth/{i:06d}.png").unlink()
        np.save(recording / f"depth/{i:06d}.npy", depth)
    assert np.array_equal(camera_of(recording).read(4)[1], images(6)[1][4])


@pytest.mark.parametrize(
    ("header", "rows", "message"),
    [
        ("timestamp, frame, x", [row(0)], "header: expected timestamp, frame.* got no column y, z, qx"),
        (HEADER, [], "header: expected timestamp, .* got no rows"),
        (HEADER, [row(1), row(0)], r"frame: expected whole numbers that increase, got \[1.0, 0.0\]"),
        (HEADER, [row(0)[:30]], "row: expected 9 values"),
        (HEADER, [row(0).replace(" 000000,", " [],")], "row: expected one number in each column"),
        (HEADER, [row(0).replace(" 000000,", " one,")], "content: expected numbers, got 'one'"),
    ],
)
def test_a_table_that_cannot_be_understood_is_refused(
    recording: Path, header: str, rows: list[str], message: str
) -> None:
    write_odometry(recording, rows, header)
    with pytest.raises(BadData, match=rf"odometry\.csv: {message}"):
        read(recording)


def test_a_table_without_header_is_read_as_the_app_orders_it(recording: Path) -> None:
    write_odometry(recording, [row(i) for i in range(1, 6)], row(0))
    assert np.allclose(camera_of(recording).world_from_cameras, POSES, atol=1e-8)


def test_files_that_are_not_named_by_numbers_and_missing_parts_are_refused(recording: Path) -> None:
    (recording / "depth/000000.png").rename(recording / "depth/first.png")
    with pytest.raises(BadData, match="depth: expected files named by the number of their frame, got first"):
        read(recording)
    (recording / "rgb.mp4").unlink()
    with pytest.raises(BadData, match=r"rgb\.mp4: expected a file, got no such path"):
        read(recording)
