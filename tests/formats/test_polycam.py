from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bask_data.errors import BadData, UsageError
from bask_data.formats import FORMATS
from bask_data.formats.options.polycam import PolycamOptions
from bask_data.formats.recording import CameraRecording, PreparedRecording
from tests.formats.folders import HEIGHT, WIDTH, K, images, rigid, write_image

OPENGL = np.diag([1.0, -1, -1, 1])
POSES = np.stack([rigid(np.random.default_rng(i)) for i in range(4)])
NAMES = ("900000", "1300000", "1700000", "2500000")
"""Microseconds; as text, the first would come last."""


def read(source: Path, **options: object) -> PreparedRecording:
    [format] = [item for item in FORMATS if item.name == "polycam"]
    return format.read(source, PolycamOptions(**{"trust": True, **options}))


def camera_of(source: Path, **options: object) -> CameraRecording:
    [camera] = read(source, **options).cameras
    return camera


def camera_file(path: Path, pose: np.ndarray, **values: Any) -> None:
    pose = pose @ OPENGL
    table = {f"t_{row}{column}": pose[row, column] for row in range(3) for column in range(4)}
    table |= {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], "width": WIDTH, "height": HEIGHT}
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({**table, "blur_score": 90.0, **values}))


@pytest.fixture
def export(tmp_path: Path) -> Path:
    """An export of four keyframes, with depth of half the size of colour and three levels of confidence."""
    folder = tmp_path / "capture"
    color, depth = images(4)
    confidence = np.array([0, 54, 255], np.uint8)[np.random.default_rng(1).integers(0, 3, (HEIGHT // 2, WIDTH // 2))]
    for name, pose, rgb, z in zip(NAMES, POSES, color, depth, strict=True):
        write_image(folder / f"keyframes/images/{name}.png", rgb)
        write_image(folder / f"keyframes/depth/{name}.png", z[::2, ::2])
        write_image(folder / f"keyframes/confidence/{name}.png", confidence)
        camera_file(folder / f"keyframes/cameras/{name}.json", pose)
    return folder


def test_keyframes_come_in_the_order_of_their_times_with_opencv_poses_on_the_pixels_of_depth(export: Path) -> None:
    recording = read(export)
    [camera] = recording.cameras
    assert np.allclose(camera.world_from_cameras, POSES, atol=1e-12)
    assert camera.time.tolist() == [0.9, 1.3, 1.7, 2.5]
    assert np.allclose(camera.K, np.diag([0.5, 0.5, 1]) @ K)
    assert (camera.depth_scale, camera.height, camera.width) == (0.001, HEIGHT // 2, WIDTH // 2)
    for i in range(4):
        rgb, raw = camera.read(i)
        assert rgb.shape == (HEIGHT // 2, WIDTH // 2, 3)
        assert np.array_equal(raw, images(4)[1][i, ::2, ::2])
    assert len(recording.files) == 16


def test_little_confidence_is_left_out_on_demand(export: Path) -> None:
    kept = camera_of(export, confidence=54).read(0)[1] > 0
    confidence = np.array([0, 54, 255])[np.random.default_rng(1).integers(0, 3, kept.shape)]
    assert np.array_equal(kept, (images(4)[1][0, ::2, ::2] > 0) & (confidence >= 54))
    (export / f"keyframes/confidence/{NAMES[1]}.png").unlink()
    assert camera_of(export).n_frames == 4
    with pytest.raises(BadData, match="confidence: expected a file for every keyframe, got none"):
        camera_of(export, confidence=54).read(1)


def test_corrected_cameras_and_images_go_before_others_and_the_app_may_reject_keyframes(export: Path) -> None:
    corrected = np.stack([rigid(np.random.default_rng(i)) for i in range(10, 14)])
    for i in (0, 2, 3):
        camera_file(export / f"keyframes/corrected_cameras/{NAMES[i]}.json", corrected[i], fx=22.0 + i)
        write_image(export / f"keyframes/corrected_images/{NAMES[i]}.png", np.full((HEIGHT, WIDTH, 3), 7 + i, np.uint8))
    recording = read(export)
    [camera] = recording.cameras
    assert np.allclose(camera.world_from_cameras, corrected[[0, 2, 3]], atol=1e-12)
    assert np.allclose(camera.Ks[:, 0, 0], [11, 12, 12.5])
    assert [int(camera.read(k)[0][0, 0, 0]) for k in range(3)] == [7, 9, 10]
    assert recording.assumptions["frames"] == f"3 of 4; 1 left out: {NAMES[1]} (no corrected pose)"


def test_blurred_keyframes_are_left_out_on_demand(export: Path) -> None:
    camera_file(export / f"keyframes/cameras/{NAMES[2]}.json", POSES[2], blur_score=12.5)
    assert camera_of(export).n_frames == 4
    recording = read(export, least_blur_score=50.0)
    assert np.allclose(recording.cameras[0].world_from_cameras, POSES[[0, 1, 3]])
    assert f"{NAMES[2]} (blurred)" in recording.assumptions["frames"]
    # Corrected cameras do not state it.
    for name, pose in zip(NAMES, POSES, strict=True):
        camera_file(export / f"keyframes/corrected_cameras/{name}.json", pose)
        path = export / f"keyframes/corrected_cameras/{name}.json"
        path.write_text(json.dumps({k: v for k, v in json.loads(path.read_text()).items() if k != "blur_score"}))
    assert camera_of(export, least_blur_score=50.0).n_frames == 3


@pytest.mark.parametrize("part", ["images", "depth", "cameras"])
def test_keyframes_that_lack_a_file_are_refused_or_left_out(export: Path, part: str) -> None:
    next((export / f"keyframes/{part}").glob(f"{NAMES[1]}.*")).unlink()
    kind = {"images": "image", "cameras": "camera"}.get(part, part)
    with pytest.raises(BadData, match=rf"{NAMES[1]}: files: expected camera, .* got no {kind}.*--skip-bad"):
        read(export)
    assert np.allclose(camera_of(export, skip_bad=True).world_from_cameras, POSES[[0, 2, 3]])


def test_a_damaged_camera_file_is_refused_or_left_out(export: Path) -> None:
    path = export / f"keyframes/cameras/{NAMES[1]}.json"
    path.write_text(path.read_text()[:40])
    with pytest.raises(BadData, match=rf"{NAMES[1]}\.json: content: expected JSON"):
        read(export)
    camera_file(path, POSES[1], fx=None)
    with pytest.raises(BadData, match=rf"{NAMES[1]}\.json: fx: expected a number, got nothing"):
        read(export)
    camera_file(path, POSES[1], t_11=None)
    with pytest.raises(BadData, match=rf"{NAMES[1]}\.json: t_00 to t_23: expected 12 numbers") as raised:
        read(export)
    assert "--skip-bad leaves out this frame" in raised.value.__notes__[-1]
    camera_file(path, POSES[1], t_11=float("nan"))
    with pytest.raises(BadData, match=rf"{NAMES[1]}\.json: pose: expected a rigid transform.*--skip-bad"):
        read(export)
    assert np.allclose(camera_of(export, skip_bad=True).world_from_cameras, POSES[[0, 2, 3]])


def test_intrinsics_of_another_size_are_refused(export: Path) -> None:
    camera_file(export / f"keyframes/cameras/{NAMES[3]}.json", POSES[3], width=2 * WIDTH)
    with pytest.raises(BadData, match=rf"height, width: expected \({HEIGHT}, {WIDTH}\), the size of the images, got"):
        read(export)


def test_the_zip_file_of_an_export_reads_as_the_export(export: Path) -> None:
    shutil.make_archive(str(export), "zip", export.parent, export.name)
    archive, folder = read(export.with_suffix(".zip")), read(export)
    for a, b in zip(archive.cameras, folder.cameras, strict=True):
        assert np.array_equal(a.world_from_cameras, b.world_from_cameras)
        for i in range(4):
            assert all(np.array_equal(x, y) for x, y in zip(a.read(i), b.read(i), strict=True))
    assert archive.files == (export.with_suffix(".zip"),)


def test_the_export_may_lie_in_a_folder_of_its_own(export: Path) -> None:
    assert np.allclose(camera_of(export.parent).world_from_cameras, POSES)
    elsewhere = export.parent / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "link").symlink_to(export)
    with pytest.raises(BadData, match="cameras: expected its files, got none"):
        read(elsewhere)


@pytest.mark.parametrize(
    ("part", "fix"),
    [("depth", "capture with LiDAR"), ("cameras", "it holds the folder keyframes"), ("images", "SOURCE")],
)
def test_an_export_without_a_part_is_refused_with_the_reason(export: Path, part: str, fix: str) -> None:
    shutil.rmtree(export / f"keyframes/{part}")
    with pytest.raises(BadData, match=f"{part}: expected its files, got none.*{fix}"):
        read(export)


def test_names_that_are_no_times_are_refused(export: Path) -> None:
    for part in ("images", "depth", "cameras"):
        path = next((export / f"keyframes/{part}").glob(f"{NAMES[0]}.*"))
        path.rename(path.with_stem("first"))
    with pytest.raises(BadData, match="names: expected files named by their time in microseconds, got first"):
        read(export)


def test_another_file_is_refused(export: Path) -> None:
    with pytest.raises(UsageError, match=r"SOURCE: expected a file \.zip"):
        read(export / f"keyframes/cameras/{NAMES[0]}.json")
