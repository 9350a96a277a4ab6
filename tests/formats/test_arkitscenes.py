from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bask_data.core.geometry import invert_rigid
from bask_data.errors import BadData
from bask_data.formats import FORMATS
from bask_data.formats.options.arkitscenes import ArkitscenesOptions
from bask_data.formats.recording import PreparedRecording
from tests.formats.folders import HEIGHT, WIDTH, K, images, rigid, write_image

VIDEO = "41000001"
TIMES = (99.95, 100.0, 100.1, 100.2)
COLOR, DEPTH = images(4)
LEVELS = np.tile(np.arange(WIDTH, dtype=np.uint8) % 3, (HEIGHT, 1))
START = rigid(np.random.default_rng(0))


def read(source: Path, **options: object) -> PreparedRecording:
    return next(item for item in FORMATS if item.name == "arkitscenes").read(source, ArkitscenesOptions(**options))


def pose(time: float) -> np.ndarray:
    """world_from_camera on a straight line, turning about one axis."""
    motion = np.eye(4)
    motion[:3, :3] = Rotation.from_rotvec([0, 0.5 * (time - 100), 0]).as_matrix()
    moved = START @ motion
    moved[:3, 3] += np.array([0.2, 0, 0.1]) * (time - 100)
    return moved


def pincam(i: int, scale: float = 1.0) -> np.ndarray:
    """K of a frame: the principal point moves."""
    moved = np.diag([scale, scale, 1]) @ K
    moved[0, 2] += 0.1 * i
    return moved


def write_pincam(path: Path, matrix: np.ndarray, size: tuple[int, int]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    fx, fy, cx, cy = matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]
    path.write_text(f"{size[1]} {size[0]} {fx:.6f} {fy:.6f} {cx:.6f} {cy:.6f}")


def write_trajectory(folder: Path, times: tuple[float, ...]) -> None:
    lines = []
    for time in times:
        camera_from_world = invert_rigid(pose(time))
        values = (*Rotation.from_matrix(camera_from_world[:3, :3]).as_rotvec(), *camera_from_world[:3, 3])
        lines.append(" ".join([f"{time:.6f}", *(f"{value:.10f}" for value in values)]))
    (folder / "lowres_wide.traj").write_text("\n".join(lines))


def write_video(folder: Path, poses_at: tuple[float, ...] = (100.0004, 100.1, 100.2)) -> None:
    """A video whose first frame comes before the first pose, as every video's does."""
    for i, time in enumerate(TIMES):
        name = f"{VIDEO}_{time:.3f}"
        write_image(folder / f"lowres_wide/{name}.png", COLOR[i])
        write_image(folder / f"lowres_depth/{name}.png", DEPTH[i])
        write_image(folder / f"confidence/{name}.png", LEVELS)
        write_pincam(folder / f"lowres_wide_intrinsics/{name}.pincam", pincam(i), (HEIGHT, WIDTH))
    write_trajectory(folder, poses_at)


def test_a_video_is_read_with_the_pose_and_the_intrinsics_of_each_image(tmp_path: Path) -> None:
    write_video(tmp_path)
    recording = read(tmp_path)
    [camera] = recording.cameras
    assert camera.time.tolist() == [100.0, 100.1, 100.2]
    # A stamp within a millisecond of the name is the same moment: its pose stands as it is.
    expected = [pose(time) for time in (100.0004, 100.1, 100.2)]
    np.testing.assert_allclose(camera.world_from_cameras, expected, atol=1e-9)
    np.testing.assert_allclose(camera.Ks, [pincam(i) for i in (1, 2, 3)])
    for k in range(3):
        rgb, depth = camera.read(k)
        assert np.array_equal(rgb, COLOR[k + 1]) and np.array_equal(depth, DEPTH[k + 1])
    assert recording.assumptions["frames"] == f"3 of 4; 1 left out: {VIDEO}_99.950 (no pose)"
    assert "interpolated" not in recording.assumptions["pose"]
    assert len(recording.files) == 4 * 4 + 1


def test_poses_at_other_times_are_interpolated(tmp_path: Path) -> None:
    write_video(tmp_path, poses_at=(99.93, 100.03, 100.13, 100.23))
    recording = read(tmp_path)
    np.testing.assert_allclose(recording.cameras[0].world_from_cameras, [pose(time) for time in TIMES], atol=1e-9)
    assert "4 of 4 interpolated on SE(3) between poses 0.1 s apart" in recording.assumptions["pose"]


def test_a_gap_in_the_trajectory_is_not_bridged_unless_asked(tmp_path: Path) -> None:
    write_video(tmp_path, poses_at=(99.9, 100.0, 100.2, 100.3))
    recording = read(tmp_path)
    assert recording.assumptions["frames"] == f"3 of 4; 1 left out: {VIDEO}_100.100 (no pose)"
    bridged = read(tmp_path, max_pose_gap=0.2)
    np.testing.assert_allclose(bridged.cameras[0].world_from_cameras, [pose(time) for time in TIMES], atol=1e-9)


def test_frames_without_depth_are_left_out_and_counted(tmp_path: Path) -> None:
    write_video(tmp_path)
    (tmp_path / f"lowres_depth/{VIDEO}_100.100.png").unlink()
    recording = read(tmp_path)
    assert recording.cameras[0].time.tolist() == [100.0, 100.2]
    assert recording.assumptions["frames"].endswith(f"{VIDEO}_99.950 (no pose), {VIDEO}_100.100 (no depth)")


def test_depth_of_little_confidence_is_left_out_on_request(tmp_path: Path) -> None:
    write_video(tmp_path)
    assert np.array_equal(read(tmp_path, confidence=2).cameras[0].read(0)[1], np.where(LEVELS >= 2, DEPTH[1], 0))
    (tmp_path / f"confidence/{VIDEO}_100.100.png").unlink()
    assert read(tmp_path).cameras[0].n_frames == 3
    with pytest.raises(BadData, match=f"confidence: frame {VIDEO}_100.100: expected a file of its time"):
        read(tmp_path, confidence=2)


def test_intrinsics_may_be_off_by_a_millisecond_and_no_more(tmp_path: Path) -> None:
    write_video(tmp_path)
    file = tmp_path / f"lowres_wide_intrinsics/{VIDEO}_100.100.pincam"
    file = file.rename(file.with_stem(f"{VIDEO}_100.101"))
    np.testing.assert_allclose(read(tmp_path).cameras[0].Ks[1], pincam(2))
    file.rename(file.with_stem(f"{VIDEO}_100.103"))
    with pytest.raises(BadData, match=f"lowres_wide_intrinsics: frame {VIDEO}_100.100: expected a file of its time"):
        read(tmp_path)
    assert read(tmp_path, skip_bad=True).cameras[0].n_frames == 2


def test_colour_of_another_resolution_takes_depths_pixels(tmp_path: Path) -> None:
    write_video(tmp_path)
    for i, time in enumerate(TIMES):
        name = f"{VIDEO}_{time + 0.004:.3f}"
        write_image(tmp_path / f"vga_wide/{name}.png", np.full((2 * HEIGHT, 2 * WIDTH, 3), 50 * i, np.uint8))
        write_pincam(tmp_path / f"vga_wide_intrinsics/{name}.pincam", pincam(i, 2), (2 * HEIGHT, 2 * WIDTH))
    recording = read(tmp_path, color="vga_wide")
    [camera] = recording.cameras
    # The last image is 4 ms after the last pose.
    assert camera.time.tolist() == [100.004, 100.104]
    assert (camera.height, camera.width) == (HEIGHT, WIDTH)
    np.testing.assert_allclose(camera.Ks, [pincam(i) for i in (1, 2)])
    np.testing.assert_allclose(camera.world_from_cameras, [pose(100.004), pose(100.104)], atol=1e-6)
    rgb, depth = camera.read(1)
    assert np.array_equal(depth, DEPTH[2]) and (rgb[1:-1, 1:-1] == 100).all()
    assert "up to 4 ms from its colour" in recording.assumptions["depth"]
    for path in (tmp_path / "lowres_wide_intrinsics").iterdir():
        path.unlink()
    (tmp_path / "lowres_wide_intrinsics").rmdir()
    scaled = read(tmp_path, color="vga_wide").cameras[0].Ks[0]
    np.testing.assert_allclose(scaled, np.diag([0.5, 0.5, 1]) @ pincam(1, 2))


def test_depth_of_the_laser_scanner_is_read_with_colour_of_its_size(tmp_path: Path) -> None:
    write_video(tmp_path)
    for old, new in (
        ("lowres_wide", "wide"),
        ("lowres_wide_intrinsics", "wide_intrinsics"),
        ("lowres_depth", "highres_depth"),
    ):
        (tmp_path / old).rename(tmp_path / new)
    recording = read(tmp_path, depth="highres_depth")
    assert np.array_equal(recording.cameras[0].read(0)[1], DEPTH[1])
    assert "z-depth of highres_depth" in recording.assumptions["depth"] and "confidence" not in recording.assumptions


def test_the_detection_sets_folder_is_found(tmp_path: Path) -> None:
    (tmp_path / f"{VIDEO}_frames").mkdir()
    write_video(tmp_path / f"{VIDEO}_frames")
    assert read(tmp_path).cameras[0].n_frames == 3


def test_what_is_missing_is_named(tmp_path: Path) -> None:
    write_video(tmp_path)
    (tmp_path / "vga_wide.zip").touch()
    with pytest.raises(BadData, match="vga_wide: folder: expected vga_wide, unpacked, got vga_wide.zip.*unpack it"):
        read(tmp_path, color="vga_wide")
    with pytest.raises(BadData, match="wide: folder: expected wide, unpacked, got none.*download this asset"):
        read(tmp_path, color="wide")
    write_image(tmp_path / "lowres_depth/preview.png", DEPTH[0])
    with pytest.raises(BadData, match="name: expected VIDEO_SECONDS, got preview"):
        read(tmp_path)
    (tmp_path / "lowres_depth/preview.png").unlink()
    (tmp_path / "lowres_wide.traj").unlink()
    with pytest.raises(BadData, match=r"lowres_wide\.traj: poses: expected a file, got no such path"):
        read(tmp_path)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("lowres_wide.traj", "100 0 0 0 0 0", "lines: expected finite numbers `time rx ry rz tx ty tz` in each"),
        ("lowres_wide.traj", "100 nan 0 0 0 0 0", "lines: expected finite numbers"),
        ("lowres_wide.traj", "101 0 0 0 0 0 0\n100 0 0 0 0 0 0", "line 2: expected times that increase"),
        (f"lowres_wide_intrinsics/{VIDEO}_100.000.pincam", "1 2 3", "expected width height fx fy cx cy, got 3 numbers"),
        (
            f"lowres_wide_intrinsics/{VIDEO}_100.000.pincam",
            "640 480 500 500 320 240",
            "images of 16 x 12, got 640 x 480",
        ),
    ],
)
def test_damaged_files_are_refused(tmp_path: Path, name: str, text: str, message: str) -> None:
    write_video(tmp_path)
    (tmp_path / name).write_text(text)
    with pytest.raises(BadData, match=message):
        read(tmp_path)


def test_intrinsics_of_other_times_are_refused(tmp_path: Path) -> None:
    write_video(tmp_path)
    for path in list((tmp_path / "lowres_wide_intrinsics").iterdir()):
        path.rename(path.with_stem(path.stem.replace("_", "_9")))
    with pytest.raises(BadData, match="intrinsics: expected those of the images, got none at any of 4 times"):
        read(tmp_path)
