from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bask_data.core.geometry import (
    in_image,
    invert_rigid,
    pixel_grid,
    project,
    rigid_fault,
    rotation_angle,
    transform,
    unproject,
)
from bask_data.errors import BadData
from bask_data.formats import FORMATS
from bask_data.formats.image_files import ImageFiles
from bask_data.formats.options.apc import ApcOptions
from bask_data.formats.recording import SourceRecording
from tests.formats.folders import median_depth_disagreement, write_image

DATASETS = Path(__file__).parents[2] / "datasets"
SCAN, DEMO = DATASETS / "apc_shelf", DATASETS / "labelfusion_shelf"


def read(source: Path, **options: object) -> SourceRecording:
    apc = next(item for item in FORMATS if item.name == "apc")
    return apc.read(source, ApcOptions(**options))


@pytest.fixture
def scan(tmp_path: Path) -> Path:
    """A copy of the shipped scan that a test may corrupt."""
    return Path(shutil.copytree(SCAN, tmp_path / "scan"))


@pytest.fixture
def demo(tmp_path: Path) -> Path:
    """A copy of the shipped demonstration that a test may corrupt."""
    return Path(shutil.copytree(DEMO, tmp_path / "demo"))


@pytest.mark.parametrize(("source", "millimetres"), [(SCAN, 4.5), (DEMO, 5.0)])
def test_the_depth_of_neighbouring_frames_agrees_in_the_shipped_recordings(source: Path, millimetres: float) -> None:
    recording = read(source)
    disagreements = [median_depth_disagreement(recording, i, i + 1) for i in range(recording.cameras[0].n_frames - 1)]
    assert 1000 * np.median(disagreements) < millimetres


@pytest.mark.parametrize(
    ("source", "names"),
    [
        (SCAN, {48: "chenille stems", 114: "bunny book", 132: "tissue box", 144: "joke book"}),
        (DEMO, {48: "chenille stems", 132: "tissue box"}),
    ],
)
def test_the_shipped_recordings_are_read_completely(source: Path, names: dict[int, str]) -> None:
    recording = read(source)
    (camera,) = recording.cameras
    assert (camera.n_frames, camera.height, camera.width, camera.depth_scale) == (15, 480, 640, 1e-4)
    assert recording.label_names == names
    assert camera.time.tolist() == list(range(15))
    assert camera.labels is not None
    for i in (0, 14):
        rgb, depth = camera.read(i)
        labels = camera.labels(i)
        assert rgb.shape == (480, 640, 3)
        assert set(np.unique(labels)) == {0, *names}
        # The box is teal: more green and blue than red shows that the channels are in order.
        red, green, blue = rgb[labels == 132].mean(axis=0)
        assert red < min(green, blue)
        assert 0.3 < np.median(depth[depth > 0]) * camera.depth_scale < 0.8
    assert len(recording.files) == (47 if source == SCAN else 62)


def test_the_world_frame_is_the_bin_if_the_files_state_it_and_else_the_robot() -> None:
    in_bin, in_robot = read(SCAN), read(SCAN, world="robot")
    assert "bin" in in_bin.assumptions["world"]
    assert "robot" in in_robot.assumptions["world"]
    assert "robot" in read(DEMO).assumptions["world"]
    # The file's numbers: the bin's origin in the robot's frame, and its rotation of 0.0158 rad about z.
    offset = in_robot.cameras[0].world_from_cameras[0, :3, 3] - [1.4732899, -0.00644825452, 1.0373053]
    turned = in_bin.cameras[0].world_from_cameras[0, :3, 3]
    assert np.allclose(
        turned, [[0.999874572, 0.0158379443, 0], [-0.0158379443, 0.999874572, 0], [0, 0, 1]] @ offset, atol=1e-6
    )
    turn = in_bin.cameras[0].world_from_cameras[0, :3, :3] @ in_robot.cameras[0].world_from_cameras[0, :3, :3].T
    assert np.isclose(rotation_angle(turn[None]), 0.0158386, atol=1e-6)


def test_a_bin_frame_that_the_files_do_not_state_is_refused() -> None:
    with pytest.raises(
        BadData, match="--world: expected the bin's transform in cam.info.txt .* got none.  fix: pass --world robot"
    ):
        read(DEMO, world="bin")


@given(st.integers(0, 65535))
def test_raw_depth_is_rotated_left_by_three_bits(tmp_path_factory, value: int) -> None:
    path = tmp_path_factory.getbasetemp() / "rotated.png"
    write_image(path, np.full((2, 2), ((value << 3) | (value >> 13)) & 0xFFFF, np.uint16))
    assert (ImageFiles((path,), (path,), rotated_depth=True).read_depth(0) == value).all()


def test_png_colour_is_read_as_well(demo: Path) -> None:
    for path in demo.glob("*.jpg"):
        write_image(path.with_suffix(".png"), cv2.imread(str(path))[..., ::-1])
        path.unlink()
    assert np.array_equal(read(demo).cameras[0].read(3)[0], read(DEMO).cameras[0].read(3)[0])


def test_a_recording_without_labels_has_none(demo: Path) -> None:
    for path in demo.glob("*.segm.png"):
        path.unlink()
    recording = read(demo)
    assert recording.cameras[0].labels is None
    assert recording.label_names == {}
    assert recording.assumptions["labels"] == "none found"


@pytest.mark.parametrize("name", ["frame-000004.segm.png", "frame-000004.pose.txt", "frame-000004.depth.png"])
def test_a_frame_without_a_partner_is_named(demo: Path, name: str) -> None:
    (demo / name).unlink()
    with pytest.raises(BadData, match="frame 000004: expected a .* file for every frame, got none for 1 of 15"):
        read(demo)


def test_a_calibration_without_a_frames_pose_is_refused(scan: Path) -> None:
    info = (scan / "cam.info.txt").read_text().replace("for frame-000007", "for nothing")
    (scan / "cam.info.txt").write_text(info)
    with pytest.raises(
        BadData, match="cam.info.txt: for frame-000007: expected one matrix under a comment with these words, got 0"
    ):
        read(scan)


def test_a_calibration_with_a_broken_pose_is_refused_by_the_frames_name(scan: Path) -> None:
    info = (scan / "cam.info.txt").read_text().replace(" 4.35946526e-01", "-4.35946526e-01", 1)
    (scan / "cam.info.txt").write_text(info)
    with pytest.raises(BadData, match="cam.info.txt of frame 000000: pose: expected a rigid transform"):
        read(scan)


def test_intrinsics_that_are_no_3x3_matrix_are_refused(scan: Path) -> None:
    info = (
        (scan / "cam.info.txt").read_text().replace("0.00000000e+00	  1.00000000e+00	", "0.00000000e+00	", 1)
    )
    (scan / "cam.info.txt").write_text(info)
    with pytest.raises(BadData, match="color camera intrinsic: expected a 3x3 matrix, got 8 numbers"):
        read(scan)


def test_an_unknown_label_keeps_its_number_as_its_name(demo: Path) -> None:
    path = demo / "frame-000004.segm.png"
    labels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    labels[0, 0] = 6
    write_image(path, labels)
    assert read(demo).label_names[6] == "label 6"


def test_ground_truth_between_the_shipped_recordings_is_rigid_and_maps_objects_onto_themselves() -> None:
    truth = json.loads((DATASETS / "shelf_truth.json").read_text())
    scan_camera, demo_camera = (read(DATASETS / truth[side]).cameras[0] for side in ("scan", "demo"))
    assert [(item["label"], item["name"]) for item in truth["objects"]] == [(132, "tissue box"), (48, "chenille stems")]
    for item in truth["objects"]:
        demo_from_scan = np.array(item["demo_from_scan"])
        assert rigid_fault(demo_from_scan, 1e-5) == ""
        hits = total = 0
        for i in (2, 7, 12):
            seen = (scan_camera.labels(i) == item["label"]) & (scan_camera.read(i)[1] > 0)
            depth = scan_camera.read(i)[1][seen] * scan_camera.depth_scale
            points = unproject(pixel_grid(480, 640)[seen], depth, scan_camera.K)
            points_demo = transform(demo_from_scan @ scan_camera.world_from_cameras[i], points)
            camera_from_demo = invert_rigid(demo_camera.world_from_cameras[i])
            uv, _ = project(transform(camera_from_demo, points_demo), demo_camera.K)
            u, v = np.rint(uv[in_image(uv, 480, 640)]).astype(int).T
            hits += int((demo_camera.labels(i)[v, u] == item["label"]).sum())
            total += len(points)
        # The labels of the stems are up to 20 pixels off, and their far end lacks a label in the demonstration.
        assert hits / total > (0.9 if item["label"] == 132 else 0.5)


def test_object_poses_are_in_the_chosen_world_frame() -> None:
    in_bin, in_robot = (read(SCAN, world=world) for world in ("bin", "robot"))
    cameras = [recording.cameras[0].world_from_cameras[0] for recording in (in_bin, in_robot)]
    objects = [recording.object_poses[132].world_from_object for recording in (in_bin, in_robot)]
    assert in_bin.object_poses[132].error == 0.008
    # camera_from_object does not depend on the world frame.
    np.testing.assert_allclose(*[invert_rigid(c) @ o for c, o in zip(cameras, objects, strict=True)], atol=1e-9)


@pytest.mark.parametrize(
    ("document", "message"),
    [
        ({"world": "bin"}, "expected world and objects"),
        ([], "expected world and objects"),
        ({"world": "moon", "objects": {}}, "world: expected bin, the recording's world frame, got moon"),
        ({"world": "bin", "objects": {"132": {"error": 1, "world_from_object": [[1, 2]]}}}, "132"),
    ],
)
def test_invalid_object_poses_are_refused(tmp_path: Path, document: object, message: str) -> None:
    folder = Path(shutil.copytree(SCAN, tmp_path / "shelf"))
    (folder / "object_poses.json").write_text(json.dumps(document))
    with pytest.raises(BadData, match=message):
        read(folder)


def test_frames_that_lack_a_file_are_refused_or_left_out_or_not_chosen(demo: Path) -> None:
    for kind in ("depth.png", "segm.png"):
        (demo / f"frame-000001.{kind}").unlink()
    (demo / "frame-000003.pose.txt").unlink()
    (demo / "frame-000000.color.jpg").unlink()
    with pytest.raises(BadData, match="frame 000000: expected a color file for every frame, got none for 1 of 15"):
        read(demo)
    recording = read(demo, skip_bad=True)
    (camera,) = recording.cameras
    assert camera.time.tolist() == [2.0, *range(4, 15)]
    assert camera.labels is not None and set(np.unique(camera.labels(0))) <= {0, 48, 132}
    assert recording.assumptions["frames"].startswith("12 of 15; 3 left out: 000000 (incomplete), 000001 (incomplete)")
    assert read(demo, frames="4:8").cameras[0].time.tolist() == [4.0, 5.0, 6.0, 7.0]


def test_links_out_of_the_folder_are_followed_where_that_is_asked_for(demo: Path, tmp_path: Path) -> None:
    outside = shutil.move(demo / "frame-000002.depth.png", tmp_path / "content")
    (demo / "frame-000002.depth.png").symlink_to(outside)
    with pytest.raises(BadData, match="frame-000002.depth.png: .*got a link out of it.  fix: pass --follow-links"):
        read(demo, frames="1:4")
    depth = read(demo, frames="1:4", follow_links=True).cameras[0].read(1)[1]
    assert np.array_equal(depth, read(DEMO, frames="1:4").cameras[0].read(1)[1])
