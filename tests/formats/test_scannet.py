from __future__ import annotations

import json
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from bask_data.core.geometry import invert_rigid
from bask_data.errors import BadData, UsageError
from bask_data.formats import FORMATS, scannet
from bask_data.formats.options.scannet import ScannetOptions
from bask_data.formats.recording import PreparedRecording
from tests.formats.folders import HEIGHT, WIDTH, K, images, rigid, write_image

NUMBERS = (0, 20, 60, 100)
LOST = 60
POSES = np.stack([rigid(np.random.default_rng(i)) for i in range(len(NUMBERS))])
POSES[2] = -np.inf
COLOR = np.repeat(np.repeat(images(4)[0], 2, axis=1), 2, axis=2)
DEPTH = images(4)[1]
COLOR_K = np.diag([2.0, 2.0, 1.0]) @ K
KEPT = [0, 1, 3]


def read(source: Path, **options: object) -> PreparedRecording:
    return next(item for item in FORMATS if item.name == "scannet").read(source, ScannetOptions(**options))


def four(matrix: np.ndarray) -> np.ndarray:
    whole = np.eye(4)
    whole[:3, :3] = matrix
    return whole


def write_export(folder: Path, color_from_body: np.ndarray | None = None) -> None:
    for i, number in enumerate(NUMBERS):
        write_image(folder / f"color/{number}.png", COLOR[i])
        write_image(folder / f"depth/{number}.png", DEPTH[i])
        (folder / "pose").mkdir(exist_ok=True)
        np.savetxt(folder / f"pose/{number}.txt", POSES[i], fmt="%f")
    (folder / "intrinsic").mkdir()
    matrices = {"intrinsic_color": four(COLOR_K), "intrinsic_depth": four(K), "extrinsic_depth": np.eye(4)}
    matrices["extrinsic_color"] = np.eye(4) if color_from_body is None else color_from_body
    for name, matrix in matrices.items():
        np.savetxt(folder / f"intrinsic/{name}.txt", matrix, fmt="%f")


def sens(color_code: int = 1, depth_code: int = 1, stamps: tuple[int, ...] = (0, 0, 0, 0), version: int = 4) -> bytes:
    """A sensor file as ScanNet's own writers make it."""
    parts = [struct.pack("<IQ", version, 5), b"Kinec"]
    parts += [np.float32(matrix).tobytes() for matrix in (four(COLOR_K), np.eye(4), four(K), np.eye(4))]
    parts += [struct.pack("<2i4IfQ", color_code, depth_code, 2 * WIDTH, 2 * HEIGHT, WIDTH, HEIGHT, 1000.0, len(POSES))]
    for i, pose in enumerate(POSES):
        suffix = {0: None, 1: ".png", 2: ".jpg"}[color_code]
        color = COLOR[i].tobytes() if suffix is None else cv2.imencode(suffix, COLOR[i][..., ::-1])[1].tobytes()
        depth = DEPTH[i].tobytes() if depth_code == 0 else zlib.compress(DEPTH[i].tobytes())
        parts += [np.float32(pose).tobytes(), struct.pack("<4Q", stamps[i], stamps[i], len(color), len(depth))]
        parts += [color, depth]
    return b"".join(parts)


def check_frames(recording: PreparedRecording, tolerance: float) -> None:
    [camera] = recording.cameras
    assert (camera.height, camera.width) == (HEIGHT, WIDTH)
    np.testing.assert_allclose(camera.K, K, rtol=tolerance)
    np.testing.assert_allclose(camera.world_from_cameras, POSES[KEPT], atol=tolerance)
    assert camera.depth_scale == pytest.approx(0.001)
    for k, i in enumerate(KEPT):
        assert np.array_equal(camera.read(k)[1], DEPTH[i])


def test_an_export_is_read_at_depths_pixels_in_the_order_of_its_numbers(tmp_path: Path) -> None:
    write_export(tmp_path)
    recording = read(tmp_path)
    check_frames(recording, 2e-6)
    np.testing.assert_allclose(recording.cameras[0].time, np.array([0, 20, 100]) / 30)
    assert recording.assumptions["frames"] == "3 of 4; 1 left out: 60 (tracking lost)"
    assert list(recording.left_out) == ["camera/60"]
    assert len(recording.files) == 3 * 4 + 4


def test_depth_is_registered_into_colour_on_request(tmp_path: Path) -> None:
    write_export(tmp_path)
    [camera] = read(tmp_path, align="color").cameras
    assert (camera.height, camera.width) == (2 * HEIGHT, 2 * WIDTH)
    np.testing.assert_allclose(camera.K, COLOR_K)
    assert np.array_equal(camera.read(0)[0], COLOR[0])


def test_extrinsics_of_two_cameras_move_depth_and_poses_into_colour(tmp_path: Path) -> None:
    color_from_body = np.eye(4)
    color_from_body[0, 3] = 0.025
    write_export(tmp_path, color_from_body)
    recording = scannet.read(tmp_path, ScannetOptions())
    assert recording.cameras[0].color_from_depth is not None
    np.testing.assert_allclose(recording.cameras[0].color_from_depth, color_from_body)
    np.testing.assert_allclose(
        recording.cameras[0].world_from_cameras[KEPT], POSES[KEPT] @ invert_rigid(color_from_body), atol=2e-6
    )
    assert "another camera" in recording.assumptions["depth"]
    assert read(tmp_path).cameras[0].height == 2 * HEIGHT


@pytest.mark.parametrize(("color_code", "depth_code"), [(0, 0), (1, 1), (2, 1)])
def test_a_sens_file_holds_what_is_exported_from_it(tmp_path: Path, color_code: int, depth_code: int) -> None:
    path = tmp_path / "scene0000_00.sens"
    path.write_bytes(sens(color_code, depth_code))
    recording = read(path)
    check_frames(recording, 2e-7)
    assert recording.files == (path,)
    assert recording.assumptions["frames"] == "3 of 4; 1 left out: 2 (tracking lost)"
    np.testing.assert_allclose(recording.cameras[0].time, np.array([0, 1, 3]) / 30)
    seen = scannet.read(tmp_path, ScannetOptions()).cameras[0].color(3)
    assert np.abs(seen.astype(int) - COLOR[3]).mean() < (0.01 if color_code < 2 else 40)


def test_stamps_of_a_sens_file_are_microseconds_if_they_increase(tmp_path: Path) -> None:
    (tmp_path / "a.sens").write_bytes(sens(stamps=(1_000_000, 1_033_000, 1_066_000, 1_100_000)))
    recording = read(tmp_path / "a.sens")
    np.testing.assert_allclose(recording.cameras[0].time, [1.0, 1.033, 1.1])
    assert recording.assumptions["time"].startswith("microseconds")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (sens()[:-5], r"frame 3: expected images inside the file, got \d+ and \d+ bytes"),
        (sens()[:100], "size: expected the frames that the header states, got a truncated file"),
        (sens(version=5), "version: expected 4, got 5"),
        (struct.pack("<IQ", 4, 1 << 40), "sensor's name: expected at most 4096 bytes"),
        (sens().replace(struct.pack("<fQ", 1000.0, 4), struct.pack("<fQ", 1000.0, 1 << 40)), "number of frames"),
        (sens().replace(struct.pack("<fQ", 1000.0, 4), struct.pack("<fQ", 0.0, 4)), "depthShift"),
        (sens().replace(struct.pack("<2I", WIDTH, HEIGHT), struct.pack("<2I", 65535, 65535)), "size of images"),
        (sens().replace(struct.pack("<2i", 1, 1), struct.pack("<2i", 1, 2), 1), "compression: .* got 1 and 2"),
    ],
)
def test_a_damaged_sens_file_is_refused(tmp_path: Path, content: bytes, message: str) -> None:
    (tmp_path / "a.sens").write_bytes(content)
    with pytest.raises(BadData, match=message):
        read(tmp_path / "a.sens")


def test_depth_that_unpacks_to_more_than_an_image_is_not_unpacked(tmp_path: Path) -> None:
    bomb, last = zlib.compress(bytes(10_000_000)), zlib.compress(DEPTH[3].tobytes())
    head = sens()[: -len(last)]
    color = len(cv2.imencode(".png", COLOR[3][..., ::-1])[1])
    head = head[: -color - 8] + struct.pack("<Q", len(bomb)) + head[len(head) - color :]
    (tmp_path / "a.sens").write_bytes(head + bomb)
    with pytest.raises(BadData, match=f"depth of frame 3: size: expected {2 * HEIGHT * WIDTH} bytes"):
        read(tmp_path / "a.sens").cameras[0].read(2)


def test_instance_labels_are_truth_and_named_by_the_annotation(tmp_path: Path) -> None:
    write_export(tmp_path)
    labels = np.repeat(np.repeat(np.arange(HEIGHT * WIDTH, dtype=np.uint8).reshape(HEIGHT, WIDTH) % 4, 2, 0), 2, 1)
    for number in NUMBERS:
        write_image(tmp_path / f"instance-filt/{number}.png", labels)
    groups = [{"objectId": 0, "label": "chair"}, {"objectId": 1, "label": "chair"}, {"objectId": 7, "label": "desk"}]
    (tmp_path / "scene.aggregation.json").write_text(json.dumps({"segGroups": groups}))
    recording = read(tmp_path)
    assert recording.label_names == {1: "chair", 2: "chair (2)", 3: "instance 3"}
    assert recording.cameras[0].labels is not None
    # The middle of a depth pixel lies on the left upper one of its four label pixels, as K is twice depth's.
    assert np.array_equal(recording.cameras[0].labels(1), labels[::2, ::2])
    (tmp_path / "instance-filt/100.png").unlink()
    lacking = read(tmp_path)
    assert not lacking.has_labels and "frames 100 lack them" in lacking.assumptions["labels"]
    (tmp_path / "scene.aggregation.json").write_text("{}")
    for number in NUMBERS:
        write_image(tmp_path / f"instance-filt/{number}.png", labels)
    with pytest.raises(BadData, match="segGroups: expected objectId and label in each"):
        read(tmp_path)


def test_labels_of_sixteen_bits_are_not_taken_for_instances(tmp_path: Path) -> None:
    write_export(tmp_path)
    for number in NUMBERS:
        write_image(tmp_path / f"instance/{number}.png", np.zeros((2 * HEIGHT, 2 * WIDTH), np.uint16))
    assert "not taken as truth: 16 bits instead of 8" in read(tmp_path).assumptions["labels"]


def test_the_benchmarks_frames_are_read(tmp_path: Path) -> None:
    write_export(tmp_path)
    for kind in ("color", "depth"):
        (tmp_path / f"intrinsic/intrinsic_{kind}.txt").rename(tmp_path / f"intrinsics_{kind}.txt")
        (tmp_path / f"intrinsic/extrinsic_{kind}.txt").unlink()
    check_frames(read(tmp_path), 2e-6)


INFO = {
    "m_depthShift": "2000",
    "m_calibrationColorIntrinsic": " ".join(f"{value:g}" for value in four(COLOR_K).ravel()),
    "m_calibrationDepthIntrinsic": " ".join(f"{value:g}" for value in four(K).ravel()),
    "m_calibrationDepthExtrinsic": "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1",
}


@pytest.mark.parametrize(("info", "inside"), [("_info.txt", ""), ("info.txt", "data/")])
def test_files_of_one_folder_beside_an_info_file_are_read(tmp_path: Path, info: str, inside: str) -> None:
    for i in range(4):
        write_image(tmp_path / f"{inside}frame-{i:06d}.color.png", COLOR[i])
        write_image(tmp_path / f"{inside}frame-{i:06d}.depth.pgm", DEPTH[i])
        np.savetxt(tmp_path / f"{inside}frame-{i:06d}.pose.txt", POSES[i], fmt="%f")
    (tmp_path / info).write_text("\n".join(f"{name} = {value}" for name, value in INFO.items()))
    recording = read(tmp_path)
    [camera] = recording.cameras
    np.testing.assert_allclose(camera.K, K)
    np.testing.assert_allclose(camera.world_from_cameras, POSES[KEPT], atol=2e-6)
    assert camera.depth_scale == pytest.approx(0.0005) and np.array_equal(camera.read(2)[1], DEPTH[3])
    assert recording.assumptions["frames"] == "3 of 4; 1 left out: frame-000002 (tracking lost)"
    (tmp_path / info).write_text("m_depthShift = 0")
    with pytest.raises(BadData, match="m_depthShift: expected units per metre, more than 0, got 0"):
        read(tmp_path)
    (tmp_path / info).write_text("m_depthShift = 1000")
    with pytest.raises(BadData, match="m_calibrationColorIntrinsic: expected its value, got none"):
        read(tmp_path)


def test_labels_beside_a_sens_file_are_truth(tmp_path: Path) -> None:
    (tmp_path / "a.sens").write_bytes(sens())
    for i in range(4):
        write_image(tmp_path / f"instance-filt/{i}.png", np.full((2 * HEIGHT, 2 * WIDTH), 1 + i, np.uint8))
    recording = read(tmp_path)
    assert recording.label_names == {i: f"instance {i}" for i in range(1, 5)}
    assert recording.cameras[0].labels is not None and (recording.cameras[0].labels(2) == 4).all()


def test_an_export_inside_the_scans_folder_is_found(tmp_path: Path) -> None:
    (tmp_path / "exported").mkdir()
    write_export(tmp_path / "exported")
    check_frames(read(tmp_path), 2e-6)


def test_a_frame_without_depth_is_refused_unless_it_may_be_left_out(tmp_path: Path) -> None:
    write_export(tmp_path)
    (tmp_path / "depth/20.png").unlink()
    with pytest.raises(BadData, match=r"frame 20: expected a depth file.*fix: pass --skip-bad"):
        read(tmp_path)
    recording = read(tmp_path, skip_bad=True)
    assert recording.cameras[0].n_frames == 2
    assert recording.assumptions["frames"].endswith("20 (incomplete), 60 (tracking lost)")


def test_what_is_no_scan_of_scannet_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadData, match=r"expected folders color, .*, an info file, or one \.sens file"):
        read(tmp_path)
    (tmp_path / "a.txt").touch()
    with pytest.raises(UsageError, match=r"expected a folder, or a file \.sens, got a file \.txt"):
        read(tmp_path / "a.txt")
    for name in ("a.sens", "b.sens"):
        (tmp_path / name).touch()
    with pytest.raises(BadData, match=r"got a\.sens, b\.sens.*name one"):
        read(tmp_path)
    (tmp_path / "iphone").mkdir()
    with pytest.raises(BadData, match=r"ScanNet\+\+.*ingest nerfstudio"):
        read(tmp_path)
