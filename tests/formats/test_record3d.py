from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import Any

import cv2
import lzfse
import numpy as np
import OpenEXR
import pytest
from scipy.spatial.transform import Rotation

from bask_data.errors import BadData, UsageError
from bask_data.formats import FORMATS
from bask_data.formats.options.record3d import Record3dOptions
from bask_data.formats.recording import CameraRecording, PreparedRecording
from tests.formats.folders import K as K_DEPTH
from tests.formats.folders import images, rigid, write_image

OPENGL = np.diag([1.0, -1, -1, 1])
N = 12
POSES = np.stack([rigid(np.random.default_rng(i)) for i in range(N)])
K = np.diag([4.0, 4.0, 1]) @ K_DEPTH
"""Of colour, 64 x 48; depth has 16 x 12."""

DEPTH = images(N)[1].astype("<f4") / 1000
DEPTH[DEPTH == 0] = np.nan
CONFIDENCE = np.random.default_rng(1).integers(0, 3, DEPTH[0].shape, dtype=np.uint8)


def read(source: Path, **options: object) -> PreparedRecording:
    [format] = [item for item in FORMATS if item.name == "record3d"]
    return format.read(source, Record3dOptions(**{"trust": True, **options}))


def camera_of(source: Path, **options: object) -> CameraRecording:
    [camera] = read(source, **options).cameras
    return camera


def metadata(**changes: Any) -> dict[str, Any]:
    """As the app writes them; values that are None are left out."""
    quat_xyzw = Rotation.from_matrix((POSES @ OPENGL)[:, :3, :3]).as_quat()
    table = {
        "w": 64,
        "h": 48,
        "dw": 16,
        "dh": 12,
        "fps": 60,
        "K": K.T.ravel().tolist(),
        "initPose": [0, 0, 0, 1, 0, 0, 0],
        "poses": np.hstack([quat_xyzw, POSES[:, :3, 3]]).tolist(),
        "frameTimestamps": [170340.5 + i / 60 for i in range(N)],
    }
    return {name: value for name, value in (table | changes).items() if value is not None}


def content(numbers: range = range(N), **changes: Any) -> dict[str, bytes]:
    """The files of a recording, with colour of brightness 20 i in frame i."""
    files = {"metadata": json.dumps(metadata(**changes)).encode()}
    for i in numbers:
        image = np.full((48, 64, 3), 20 * i, np.uint8)
        files[f"rgbd/{i}.jpg"] = cv2.imencode(".jpg", image)[1].tobytes()
        files[f"rgbd/{i}.depth"] = lzfse.compress(DEPTH[i].tobytes())
        files[f"rgbd/{i}.conf"] = lzfse.compress(CONFIDENCE.tobytes())
    return files


def write(path: Path, files: dict[str, bytes]) -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in sorted(files.items()):
            archive.writestr(name, data)
    return path


def assert_is_whole(camera: CameraRecording) -> None:
    assert np.allclose(camera.world_from_cameras, POSES, atol=1e-9)
    assert np.allclose(camera.K, K_DEPTH)
    for i in range(N):
        rgb, raw = camera.read(i)
        assert abs(rgb.mean() - 20 * i) < 2, i
        assert np.allclose(raw * camera.depth_scale, np.nan_to_num(DEPTH[i]), atol=0.51 * camera.depth_scale)


def test_frames_are_joined_by_their_numbers_with_opencv_poses_on_the_pixels_of_depth(tmp_path: Path) -> None:
    path = write(tmp_path / "a.r3d", content())
    recording = read(path)
    assert_is_whole(recording.cameras[0])
    assert np.allclose(recording.cameras[0].time, 170340.5 + np.arange(N) / 60)
    assert recording.files == (path,)


def test_the_content_of_the_file_reads_as_the_file(tmp_path: Path) -> None:
    for name, data in content().items():
        path = tmp_path / "scan" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
    recording = read(tmp_path / "scan")
    assert_is_whole(recording.cameras[0])
    assert len(recording.files) == 1 + 3 * N


def test_an_export_of_exr_and_jpg_images_is_read(tmp_path: Path) -> None:
    for i in range(N):
        write_image(tmp_path / f"rgb/{i}.jpg", np.full((48, 64, 3), 20 * i, np.uint8))
        (tmp_path / "depth").mkdir(exist_ok=True)
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        OpenEXR.File(header, {"R": np.nan_to_num(DEPTH[i])}).write(str(tmp_path / f"depth/{i}.exr"))
    (tmp_path / "metadata.json").write_text(json.dumps(metadata(dw=None, dh=None)))
    assert_is_whole(camera_of(tmp_path))


def test_intrinsics_may_differ_from_frame_to_frame(tmp_path: Path) -> None:
    rows = [[80 + i, 84, 30, 22 - i / 4] for i in range(N)]
    camera = camera_of(write(tmp_path / "a.r3d", content(perFrameIntrinsicCoeffs=rows)))
    assert np.allclose(camera.Ks[:, 0, 0], 20 + np.arange(N) / 4)
    assert np.allclose(camera.Ks[:, 1, 2], 5.5 - np.arange(N) / 16)
    with pytest.raises(BadData, match="perFrameIntrinsicCoeffs: expected fx, fy, cx, cy for each of 12 poses, got 11"):
        read(write(tmp_path / "b.r3d", content(perFrameIntrinsicCoeffs=rows[:-1])))


def test_a_matrix_written_row_by_row_is_recognised(tmp_path: Path) -> None:
    assert np.allclose(camera_of(write(tmp_path / "a.r3d", content(K=K.ravel().tolist()))).K, K_DEPTH)


def test_intrinsics_for_images_of_another_resolution_are_scaled_or_refused(tmp_path: Path) -> None:
    half = (np.diag([0.5, 0.5, 1]) @ K).T.ravel().tolist()
    recording = read(write(tmp_path / "a.r3d", content(w=32, h=24, K=half)))
    assert np.allclose(recording.cameras[0].K, K_DEPTH)
    assert "state it for 32 x 24, scaled to the images' 64 x 48" in recording.assumptions["intrinsics"]
    with pytest.raises(BadData, match="w, h: expected images of 48 x 64, or of the same proportions, got 64 x 48"):
        read(write(tmp_path / "b.r3d", content(w=48, h=64)))


def test_older_files_state_neither_the_size_of_depth_nor_times(tmp_path: Path) -> None:
    camera = camera_of(write(tmp_path / "a.r3d", content(dw=None, dh=None, frameTimestamps=None)))
    assert_is_whole(camera)
    assert np.allclose(camera.time, np.arange(N) / 60)


def test_depth_that_is_not_compressed_is_read(tmp_path: Path) -> None:
    files = content() | {f"rgbd/{i}.depth": DEPTH[i].tobytes() for i in range(N)}
    assert_is_whole(camera_of(write(tmp_path / "a.r3d", files)))


def test_little_confidence_is_left_out_on_demand(tmp_path: Path) -> None:
    camera = camera_of(write(tmp_path / "a.r3d", content()), confidence=1)
    assert np.array_equal(camera.read(3)[1] > 0, np.isfinite(DEPTH[3]) & (CONFIDENCE >= 1))
    files = content()
    del files["rgbd/4.conf"]
    path = write(tmp_path / "b.r3d", files)
    assert camera_of(path).n_frames == N
    with pytest.raises(BadData, match=r"rgbd/4\.conf: confidence: expected a file for every frame, got none"):
        camera_of(path, confidence=1).read(4)


def test_frames_that_lack_something_are_refused_or_left_out(tmp_path: Path) -> None:
    files = content()
    del files["rgbd/2.depth"], files["rgbd/5.jpg"], files["rgbd/7.jpg"], files["rgbd/7.depth"]
    files["metadata"] = json.dumps(metadata(poses=metadata()["poses"][:-1])).encode()
    path = write(tmp_path / "a.r3d", files)
    with pytest.raises(BadData, match="frame 2: expected colour, depth and a pose .* got no depth.*--skip-bad"):
        read(path)
    recording = read(path, skip_bad=True)
    kept = [0, 1, 3, 4, 6, 8, 9, 10]
    assert np.allclose(recording.cameras[0].world_from_cameras, POSES[kept], atol=1e-9)
    assert np.allclose(recording.cameras[0].time, 170340.5 + np.array(kept) / 60)
    assert "got no colour and no depth" in recording.left_out["camera/7"]
    assert "got no pose" in recording.left_out["camera/11"]


def test_frames_of_a_part_of_the_numbers_have_the_poses_in_their_order(tmp_path: Path) -> None:
    table = metadata()
    part = {"poses": table["poses"][4:9], "frameTimestamps": table["frameTimestamps"][4:9]}
    camera = camera_of(write(tmp_path / "a.r3d", content(range(4, 9), **part)))
    assert np.allclose(camera.world_from_cameras, POSES[4:9], atol=1e-9)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"poses": None}, "poses: expected a pose for each frame, got none"),
        ({"poses": [[1, 2, 3]]}, "poses: expected n x 7 numbers"),
        ({"K": None}, "K: expected 9 numbers, got None"),
        ({"K": [1.0] * 9}, "K: expected a pinhole matrix, column by column"),
        ({"dw": 20_000, "dh": 20_000}, "dw, dh: expected 1 to 100000000 pixels, got 20000 x 20000"),
        ({"dw": "16"}, "dw, dh: expected 1 to"),
        ({"dw": 17}, "size: expected 816 bytes when decoded, got 768"),
        ({"frameTimestamps": "soon"}, "frameTimestamps: expected n numbers, got 'soon'"),
        ({"frameTimestamps": None, "fps": 0}, "fps: expected above 0, got 0"),
    ],
)
def test_metadata_that_cannot_be_understood_are_refused(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(BadData, match=message):
        read(write(tmp_path / "a.r3d", content(**changes)))


def test_a_recording_of_one_frame_may_have_its_pose_as_the_initial_one(tmp_path: Path) -> None:
    initial = metadata()["poses"][0]
    camera = camera_of(write(tmp_path / "a.r3d", content(range(1), poses=None, initPose=initial)))
    assert np.allclose(camera.world_from_cameras, POSES[:1], atol=1e-9)


def test_damaged_depth_is_refused_or_left_out(tmp_path: Path) -> None:
    files = content()
    files["rgbd/6.depth"] = files["rgbd/6.depth"][:-20]
    path = write(tmp_path / "a.r3d", files)
    with pytest.raises(BadData, match=r"a\.r3d/rgbd/6\.depth: content: expected data compressed by LZFSE"):
        camera_of(path).read(6)
    assert camera_of(path, skip_bad=True).n_frames == N - 1


@pytest.mark.parametrize("name", ["metadata", "rgbd/0.jpg"])
def test_a_file_without_a_part_is_refused(tmp_path: Path, name: str) -> None:
    files = {key: data for key, data in content(range(1)).items() if key != name}
    with pytest.raises(BadData, match="metadata: expected a file, got none|images: expected rgbd/0"):
        read(write(tmp_path / "a.r3d", files))


def test_other_files_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a.mp4").write_bytes(b"x")
    with pytest.raises(UsageError, match=r"SOURCE: expected a file \.r3d or \.zip"):
        read(tmp_path / "a.mp4")
