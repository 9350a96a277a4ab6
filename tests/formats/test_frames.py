from __future__ import annotations

import pickle
from pathlib import Path

import cv2
import numpy as np
import pydantic
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from bask_data.core.geometry import invert_rigid
from bask_data.errors import BadData, BaskError
from bask_data.formats import FORMATS
from bask_data.formats.options.frames import FramesOptions
from bask_data.formats.recording import SourceRecording
from tests.formats.folders import INTRINSICS, K, images, median_depth_disagreement, rigid, write_frames, write_image

OPENCV_FROM_OPENGL = np.diag([1.0, -1, -1, 1])


def read(source: Path, **options: object) -> SourceRecording:
    frames = next(item for item in FORMATS if item.name == "frames")
    return frames.read(source, FramesOptions(**{"intrinsics": INTRINSICS, **options}))


@settings(max_examples=20)
@given(
    st.integers(0, 10**6),
    st.integers(1, 3),
    st.sampled_from(["matrix", "rows", "quaternion"]),
    st.booleans(),
    st.booleans(),
)
def test_poses_written_in_any_convention_are_read_back(
    tmp_path_factory, seed: int, n: int, form: str, inverse: bool, opengl: bool
) -> None:
    folder = tmp_path_factory.mktemp("frames")
    rng = np.random.default_rng(seed)
    world_from_cameras = np.stack([rigid(rng) for _ in range(n)])
    written = world_from_cameras @ OPENCV_FROM_OPENGL if opengl else world_from_cameras
    written = invert_rigid(written) if inverse else written
    write_frames(folder, written, seed=seed)
    for path, pose in zip(sorted(folder.glob("*.txt")), written, strict=True):
        if form == "rows":
            np.savetxt(path, pose[:3])
        elif form == "quaternion":
            np.savetxt(path, np.r_[pose[:3, 3], Rotation.from_matrix(pose[:3, :3]).as_quat()][None])
    recording = read(
        folder,
        pose_is="camera_from_world" if inverse else "world_from_camera",
        axes="opengl" if opengl else "opencv",
        camera="wrist",
    )
    (camera,) = recording.cameras
    assert np.allclose(camera.world_from_cameras, world_from_cameras, atol=1e-9)
    assert (camera.name, camera.height, camera.width, camera.depth_scale, camera.n_frames) == (
        "wrist",
        12,
        16,
        0.001,
        n,
    )
    assert np.array_equal(camera.K, K)
    color, depth = images(n, seed)
    for i in range(n):
        rgb, raw = camera.read(i)
        assert np.array_equal(rgb, color[i])
        assert np.array_equal(raw, depth[i])
    assert sorted(recording.files) == sorted(folder.iterdir())


def test_frames_are_ordered_and_timed_by_their_numbers(tmp_path: Path) -> None:
    poses = np.stack([rigid(np.random.default_rng(i)) for i in range(3)])
    write_frames(tmp_path, poses, names=["9", "10", "2"])
    recording = read(tmp_path, fps=10)
    assert np.allclose(recording.cameras[0].world_from_cameras, poses[[2, 0, 1]])
    assert np.allclose(recording.cameras[0].time, [0.2, 0.9, 1.0])
    assert recording.assumptions["time"] == "frame number / 10 per second"


def test_frames_without_numbers_are_timed_by_their_position(tmp_path: Path) -> None:
    write_frames(tmp_path, np.stack([np.eye(4)] * 2), names=["left", "right"])
    recording = read(tmp_path, fps=2)
    assert recording.cameras[0].time.tolist() == [0, 0.5]
    assert "place in the sorted list" in recording.assumptions["time"]


def test_time_can_come_from_a_file_or_from_the_names(tmp_path: Path) -> None:
    write_frames(tmp_path, np.stack([np.eye(4)] * 2), names=["12.25", "12.5"])
    (tmp_path / "times.txt").write_text("# s\ntimestamp\n3.5\n4.5\n")
    recording = read(tmp_path, timestamps="times.txt")
    assert recording.cameras[0].time.tolist() == [3.5, 4.5]
    assert tmp_path / "times.txt" in recording.files
    assert read(tmp_path, timestamps="name").cameras[0].time.tolist() == [12.25, 12.5]


def test_times_that_do_not_fit_the_frames_are_refused(tmp_path: Path) -> None:
    write_frames(tmp_path, np.stack([np.eye(4)] * 2), names=["a1", "a2"])
    (tmp_path / "times.txt").write_text("3.5\n")
    with pytest.raises(BadData, match="--timestamps: expected 2 lines of one time each, got 1 lines"):
        read(tmp_path, timestamps="times.txt")
    with pytest.raises(BadData, match="--timestamps name: expected \\* to match a time in seconds, got 'a1'"):
        read(tmp_path, timestamps="name")


def test_invalid_depth_becomes_no_measurement_and_nothing_else_changes(tmp_path: Path) -> None:
    write_frames(tmp_path, np.eye(4)[None])
    depth = images(1)[1][0]
    depth[0, :3] = [65535, 65534, 2047]
    write_image(tmp_path / "frame-000000.depth.png", depth)
    expected = depth.copy()
    expected[0, [0, 2]] = 0
    recording = read(tmp_path, invalid_depth="65535,2047")
    assert np.array_equal(recording.cameras[0].read(0)[1], expected)
    assert "0 and 65535,2047 = no measurement" in recording.assumptions["depth"]


def test_depth_that_is_all_invalid_values_is_refused(tmp_path: Path) -> None:
    write_frames(tmp_path, np.eye(4)[None])
    write_image(tmp_path / "frame-000000.depth.png", np.full((12, 16), 65535, np.uint16))
    with pytest.raises(BadData, match="expected a measurement somewhere in the recording"):
        read(tmp_path, invalid_depth=65535)


def test_poses_can_be_in_one_file_in_order_or_by_frame_number(tmp_path: Path) -> None:
    poses = np.stack([rigid(np.random.default_rng(i)) for i in range(2)])
    write_frames(tmp_path, poses, names=["3", "12"])
    lines = [np.r_[pose[:3, 3], Rotation.from_matrix(pose[:3, :3]).as_quat()] for pose in poses]
    np.savetxt(tmp_path / "poses.txt", lines)
    np.savetxt(tmp_path / "numbered.txt", [np.r_[12, lines[1]], np.r_[3, lines[0]], np.r_[99, lines[0]]])
    np.savetxt(tmp_path / "kitti.txt", poses[:, :3].reshape(2, 12))
    for name in ("poses.txt", "numbered.txt", "kitti.txt"):
        assert np.allclose(read(tmp_path, pose=name).cameras[0].world_from_cameras, poses)


def test_a_pose_file_that_does_not_fit_the_frames_is_refused(tmp_path: Path) -> None:
    write_frames(tmp_path, np.stack([np.eye(4)] * 3), names=["3", "4", "12"])
    (tmp_path / "poses.txt").write_text("0 0 0 0 0 0 1\n0 0 0 0 0 0 1\n")
    (tmp_path / "numbered.txt").write_text("3 0 0 0 0 0 0 1\n4 0 0 0 0 0 0 1\n")
    with pytest.raises(BadData, match="poses.txt: pose: expected a pose for each of 3 frames, got 2"):
        read(tmp_path, pose="poses.txt")
    with pytest.raises(
        BadData, match="numbered.txt: pose: expected a line for every frame, got none that starts with the number of 12"
    ):
        read(tmp_path, pose="numbered.txt")


@pytest.mark.parametrize("kind", ["color.png", "depth.png", "pose.txt"])
def test_a_frame_without_a_partner_is_named(tmp_path: Path, kind: str) -> None:
    write_frames(tmp_path, np.stack([np.eye(4)] * 3))
    (tmp_path / f"frame-000001.{kind}").unlink()
    with pytest.raises(
        BadData, match=f"frame 000001: expected a {kind.split('.')[0]} file for every frame, got none for 1 of 3"
    ):
        read(tmp_path)


def test_a_scaled_pose_is_refused_with_its_file(tmp_path: Path) -> None:
    write_frames(tmp_path, np.stack([np.eye(4), np.diag([1000.0, 1000, 1000, 1])]))
    with pytest.raises(
        BadData,
        match=r"frame-000001.pose.txt: pose: expected a rigid transform, got a scaled frame \(axis lengths 1000",
    ):
        read(tmp_path)


@pytest.mark.parametrize("broken", [b"", b"\x89PNG\r\n\x1a\n", b"\x00" * 100])
@pytest.mark.parametrize("kind", ["color", "depth"])
def test_a_broken_image_is_refused_when_it_is_read(tmp_path: Path, kind: str, broken: bytes) -> None:
    write_frames(tmp_path, np.stack([np.eye(4)] * 3))
    (tmp_path / f"frame-000002.{kind}.png").write_bytes(broken)
    with pytest.raises(BadData, match=f"frame-000002.{kind}.png"):
        read(tmp_path).cameras[0].read(2)


def test_a_recording_whose_first_images_are_broken_is_read_without_them(tmp_path: Path) -> None:
    poses = np.stack([rigid(np.random.default_rng(i)) for i in range(4)])
    write_frames(tmp_path, poses)
    (tmp_path / "frame-000000.color.png").write_bytes(b"GIF89a")
    (tmp_path / "frame-000001.depth.png").write_bytes(b"GIF89a")
    (tmp_path / "frame-000002.color.png").unlink()
    (camera,) = read(tmp_path, skip_bad=True).cameras
    assert np.allclose(camera.world_from_cameras, poses[[3]], atol=1e-9)
    for path in tmp_path.glob("*.color.png"):
        path.write_bytes(b"GIF89a")
    with pytest.raises(BadData, match="frame-000000.color.png: image: expected a PNG"):
        read(tmp_path, skip_bad=True)


def test_swapped_depth_and_colour_are_detected(tmp_path: Path) -> None:
    write_frames(tmp_path, np.eye(4)[None])
    with pytest.raises(BadData, match="expected 8 bits per channel, got 16"):
        read(tmp_path, color="frame-*.depth.png", depth="frame-*.color.png")


@pytest.mark.parametrize(
    "options",
    [
        {"depth_scale": 0},
        {"depth_scale": -1},
        {"depth_scale": float("nan")},
        {"fps": 0},
        {"pose_is": "c2w"},
        {"axes": "ros"},
        {"invalid_depth": "many"},
        {"intrinsics_size": "640"},
        {"camera": "../up"},
        {"camera": ""},
        {"colour": "*"},
    ],
)
def test_invalid_options_are_refused(options: dict[str, object]) -> None:
    with pytest.raises(pydantic.ValidationError):
        FramesOptions(**options)


def test_a_camera_can_be_sent_to_another_process(tmp_path: Path) -> None:
    write_frames(tmp_path, np.eye(4)[None])
    camera = pickle.loads(pickle.dumps(read(tmp_path).cameras[0]))  # noqa: S301 - our own bytes
    assert np.array_equal(camera.read(0)[1], images(1)[1][0])


@settings(max_examples=200)
@given(
    st.sampled_from(["frame-000000.color.png", "frame-000000.depth.png", "frame-000000.pose.txt"]),
    st.binary(max_size=64),
    st.integers(0, 200),
)
def test_arbitrary_bytes_in_a_file_give_frames_or_an_error_with_its_name(
    tmp_path_factory, name: str, junk: bytes, at: int
) -> None:
    folder = tmp_path_factory.mktemp("junk")
    write_frames(folder, np.eye(4)[None])
    data = bytearray((folder / name).read_bytes())
    data[at : at + len(junk)] = junk
    (folder / name).write_bytes(data)
    message = name
    try:
        read(folder).cameras[0].read(0)
    except BaskError as error:
        message = str(error)
    assert name in message


def test_assumptions_state_everything_that_the_files_do_not(tmp_path: Path) -> None:
    write_frames(tmp_path, np.eye(4)[None])
    assert set(read(tmp_path).assumptions) == {
        "pose",
        "camera axes",
        "depth",
        "intrinsics",
        "time",
        "agreement",
        "registration",
    }


def test_a_recording_is_consistent_in_its_own_convention_only(
    tmp_path: Path,
) -> None:
    shelf = Path(__file__).parents[2] / "datasets" / "labelfusion_shelf"
    for path in sorted(shelf.glob("frame-*.depth.png"))[:2]:
        raw = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        write_image(tmp_path / path.name, (raw >> 3) | (raw << 13))
        for suffix in ("color.jpg", "pose.txt"):
            source = shelf / path.name.replace("depth.png", suffix)
            (tmp_path / source.name).write_bytes(source.read_bytes())
    options = {
        "color": "frame-*.color.jpg",
        "intrinsics": str(shelf / "camera-intrinsics.color.txt"),
        "depth_scale": 1e-4,
    }
    assert median_depth_disagreement(read(tmp_path, **options), 0, 1) < 0.006
    for wrong in ({"pose_is": "camera_from_world"}, {"axes": "opengl"}):
        assert not median_depth_disagreement(read(tmp_path, **options, **wrong), 0, 1) < 0.03
