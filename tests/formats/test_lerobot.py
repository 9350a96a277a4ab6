from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from scipy.spatial.transform import Rotation

from bask_data.core.geometry import invert_rigid
from bask_data.errors import BadData, UsageError
from bask_data.formats import FORMATS, lerobot
from bask_data.formats.options.lerobot import LerobotOptions
from bask_data.formats.recording import SourceRecording
from tests.formats.lerobot_sets import (
    FPS,
    INTRINSICS,
    LINEAR,
    LOG,
    N_FRAMES,
    POSES,
    WRIST,
    WRIST_DEPTH,
    K,
    LerobotSet,
    codes,
    color,
    depth_mm,
    feature,
    png,
    tiff,
)

COLUMN = "observation.camera.wrist.world_from_camera"
SECOND = range(3, 7)
"""Rows of the second episode."""

HALF_STEP = 0.0008
"""Metres: half a step of the logarithmic codes at 1.2 m, which depth does not exceed."""


def read(source: Path, **options: object) -> SourceRecording:
    return lerobot.read(source, LerobotOptions(**{"episode": "1", "intrinsics": INTRINSICS, **options}))


def check_frames(recording: SourceRecording, tolerance: float = 0.0, rows: range = SECOND) -> None:
    """Check colour and depth, metres, of an episode."""
    [camera] = recording.cameras
    assert len(camera.frames) == len(rows)
    for i, row in enumerate(rows):
        assert np.abs(camera.color(i).astype(int) - color(row)).max() <= 3
        raw = camera.depth(i)
        expected = depth_mm(row)
        assert ((raw > 0) == (expected > 0)).all()
        np.testing.assert_allclose(raw * camera.depth_scale, expected / 1000, atol=tolerance, rtol=1e-6)


@pytest.fixture(scope="module")
def filmed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return LerobotSet().write(tmp_path_factory.mktemp("lerobot") / "d")


def test_an_episode_in_the_middle_of_shared_files_is_read(filmed: Path) -> None:
    recording = read(filmed)
    [camera] = recording.cameras
    assert (camera.name, camera.lens.size) == ("wrist", (32, 48))
    np.testing.assert_array_equal(camera.world_from_cameras, POSES[3:])
    np.testing.assert_array_equal(camera.lens.K, K)
    np.testing.assert_array_equal(camera.time, np.arange(4) / FPS)
    check_frames(recording, tolerance=HALF_STEP)
    check_frames(read(filmed, episode="0"), tolerance=HALF_STEP, rows=range(3))
    assert (recording.assumptions["episode"], recording.assumptions["task"]) == ("1 of 2", "stir")
    assert camera.color(3).mean() > camera.color(0).mean() + 60  # Going back works, too.
    assert {file.name for file in recording.files} == {"info.json", "file-000.parquet", "file-000.mp4"}
    assert len(recording.files) == 5


def test_the_format_is_prepared_with_depth_to_a_fifth_of_a_millimetre(filmed: Path) -> None:
    entry = next(item for item in FORMATS if item.name == "lerobot")
    prepared = entry.read(filmed, LerobotOptions(episode="1", intrinsics=INTRINSICS))
    assert prepared.cameras[0].depth_scale == 0.0002
    assert entry.episodes(filmed, LerobotOptions()) == ("0", "1")


def test_one_of_several_episodes_must_be_named(filmed: Path) -> None:
    with pytest.raises(UsageError, match="--episode: expected one of 0, 1, got none, but the source holds 2"):
        read(filmed, episode="")
    with pytest.raises(UsageError, match="--episode: expected one of 0, 1, got 2"):
        read(filmed, episode="2")


def test_linear_codes_are_read_and_zero_stays_no_measurement(tmp_path: Path) -> None:
    made = LerobotSet()
    made.features[WRIST_DEPTH]["info"] = {"is_depth_map": True, **LINEAR}
    made.videos[WRIST_DEPTH] = (*made.videos[WRIST_DEPTH][:3], lambda i: codes(depth_mm(i) / 1000, LINEAR))
    recording = read(made.write(tmp_path / "d"))
    check_frames(recording, tolerance=0.0005)
    assert "linear" in recording.assumptions["depth"]


def test_depth_beyond_the_largest_code_is_no_measurement(tmp_path: Path) -> None:
    made = LerobotSet()
    near = {**LOG, "video.depth_max": 1.1}
    made.features[WRIST_DEPTH]["info"] |= near
    made.videos[WRIST_DEPTH] = (*made.videos[WRIST_DEPTH][:3], lambda i: codes(depth_mm(i) / 1000, near))
    raw = read(made.write(tmp_path / "d")).cameras[0].depth(0)
    expected = depth_mm(3)
    assert ((raw > 0) == ((expected > 0) & (expected < 1100))).all()
    assert (raw > 0).any()


def test_a_video_of_twelve_bits_without_a_formula_has_lerobots(tmp_path: Path) -> None:
    made = LerobotSet()
    made.features[WRIST_DEPTH]["info"] = {"video.is_depth_map": True}
    recording = read(made.write(tmp_path / "d"))
    check_frames(recording, tolerance=HALF_STEP)
    assert "LeRobot's defaults, as the files do not say" in recording.assumptions["depth"]
    millimetres = read(tmp_path / "d", depth_scale=0.5)
    assert millimetres.cameras[0].depth(0).dtype == np.uint16 and millimetres.cameras[0].depth_scale == 0.5


def test_a_video_of_sixteen_bits_without_a_formula_is_in_units(tmp_path: Path) -> None:
    made = LerobotSet()
    made.features[WRIST_DEPTH]["info"] = {"is_depth_map": True}
    made.videos[WRIST_DEPTH] = ("ffv1", "gray16le", {}, depth_mm)
    made.info["video_path"] = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mkv"
    folder = made.write(tmp_path / "d")
    for path in (folder / "videos").rglob("*.mp4"):
        path.rename(path.with_suffix(".mkv"))
    recording = read(folder)
    check_frames(recording)
    assert recording.cameras[0].depth_scale == 0.001


@pytest.mark.parametrize(
    ("info", "message"),
    [
        ({"video.depth_min": 11.0}, "expected video.depth_min < video.depth_max"),
        ({"video.shift": -0.01}, "a shift that keeps their logarithms finite"),
        ({"video.use_log": "yes"}, "use_log"),
        ({"video.depth_max": float("inf")}, "in metres"),
    ],
)
def test_a_formula_that_gives_no_depth_is_refused(filmed: Path, tmp_path: Path, info: dict, message: str) -> None:
    made = LerobotSet()
    made.features[WRIST_DEPTH]["info"] |= info
    made.videos.clear()
    folder = made.write(tmp_path / "d")
    (folder / "videos").symlink_to(filmed / "videos")
    (folder / "meta/episodes/chunk-000/file-000.parquet").unlink()
    (folder / "meta/episodes/chunk-000/file-000.parquet").write_bytes(
        (filmed / "meta/episodes/chunk-000/file-000.parquet").read_bytes()
    )
    with pytest.raises(BadData, match=f"features.{WRIST_DEPTH}.info: .*{message}"):
        read(folder, follow_links=True)


def test_depth_for_the_eye_is_refused(tmp_path: Path) -> None:
    made = LerobotSet()
    made.videos[WRIST_DEPTH] = ("libx264", "yuv420p", {"crf": "4"}, color)
    with pytest.raises(BadData, match="depth: expected 12 or 16 bits per pixel, got 8: depth for the eye"):
        read(made.write(tmp_path / "d"))


def test_depth_as_image_files_is_read_in_the_stated_unit(tmp_path: Path) -> None:
    metres = [(depth_mm(i) / 1000).astype(np.float32) for i in range(N_FRAMES)]
    contents = {
        "png": ([png(depth_mm(i)) for i in range(N_FRAMES)], {"is_depth_map": True, "depth_unit": "mm"}, 0.001),
        "tiff": ([tiff(depth_mm(i)) for i in range(N_FRAMES)], {"is_depth_map": True}, 0.001),
        "float": ([tiff(depth) for depth in metres], {"is_depth_map": True}, 1.0),
    }
    for name, (files, info, scale) in contents.items():
        made = LerobotSet()
        made.replace_video(WRIST_DEPTH, made.files(files), dtype="image", info=info)
        recording = read(made.write(tmp_path / name))
        check_frames(recording, tolerance=1e-6)
        assert recording.cameras[0].depth_scale == scale
    scaled = read(tmp_path / "tiff", depth_scale=0.0001)
    assert scaled.cameras[0].depth_scale == 0.0001 and "(given)" in scaled.assumptions["depth"]


def test_images_beside_the_table_are_read_and_belong_to_the_source(tmp_path: Path) -> None:
    made = LerobotSet()
    paths = [f"images/wrist/frame_{i:06d}.png" for i in range(N_FRAMES)]
    made.replace_video(WRIST, made.files([None] * N_FRAMES, paths), dtype="image")
    folder = made.write(tmp_path / "d")
    for i, path in enumerate(paths):
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_bytes(png(color(i)))
    recording = read(folder)
    check_frames(recording, tolerance=HALF_STEP)
    assert [file.name for file in recording.files if file.suffix == ".png"] == [Path(p).name for p in paths[3:]]


@pytest.mark.parametrize("column", ["none", "names", "absolute"])
def test_images_where_lerobot_puts_them_are_found_and_missing_ones_are_faults(tmp_path: Path, column: str) -> None:
    made = LerobotSet()
    paths = [f"{'/home/else/' * (column == 'absolute')}frame-{i:06d}.tiff" for i in range(N_FRAMES)]
    made.replace_video(WRIST_DEPTH, made.files([None] * N_FRAMES, paths), dtype="image")
    if column == "none":
        del made.columns[WRIST_DEPTH]
    folder = made.write(tmp_path / "d")
    beside = folder / f"images/{WRIST_DEPTH}/episode-000001"
    beside.mkdir(parents=True)
    for i in range(4):
        (beside / f"frame-{i:06d}.tiff").write_bytes(tiff(depth_mm(3 + i)))
    check_frames(read(folder))
    (beside / "frame-000000.tiff").unlink()
    camera = read(folder).cameras[0]
    assert list(camera.faults) == [0]
    np.testing.assert_array_equal(camera.depth(1), depth_mm(4))


@pytest.mark.parametrize(
    ("path", "message"),
    [
        ("../secret.png", "expected a path inside the source folder"),
        ("/etc/hostname", "expected a path inside the source folder"),
        ("https://example.org/0.png", "expected images in the dataset, got an address"),
        ("images/none.png", "no such path"),
    ],
)
def test_paths_of_images_that_lead_out_are_refused(tmp_path: Path, path: str, message: str) -> None:
    made = LerobotSet()
    made.replace_video(WRIST, made.files([None] * N_FRAMES, [path] * N_FRAMES), dtype="image")
    with pytest.raises(BadData, match=message):
        read(made.write(tmp_path / "d"))


def test_depth_as_arrays_is_read_by_the_features_shape(tmp_path: Path) -> None:
    depth = np.stack([depth_mm(i) for i in range(N_FRAMES)])
    nested = pa.array(depth.tolist(), pa.list_(pa.list_(pa.uint16())))
    flat = pa.FixedSizeListArray.from_arrays(pa.array((depth / 1000).astype(np.float32).reshape(-1)), depth[0].size)
    for name, column, dtype, shape in (
        ("nested", nested, "uint16", [32, 48]),
        ("flat", flat, "float32", [1, 32, 48]),
    ):
        made = LerobotSet()
        made.replace_video(WRIST_DEPTH, column, dtype=dtype, shape=shape, info=None)
        check_frames(read(made.write(tmp_path / name)), tolerance=1e-6)


def test_arrays_that_are_no_images_are_refused(tmp_path: Path) -> None:
    made = LerobotSet()
    column = pa.FixedSizeListArray.from_arrays(pa.array(np.ones(N_FRAMES * 8, np.uint16)), 8)
    made.replace_video(WRIST_DEPTH, column, dtype="uint16", shape=[32, 48], info=None)
    with pytest.raises(BadData, match=r"expected an image of the shape \[32, 48\], got uint16 \[8\]"):
        read(made.write(tmp_path / "d")).cameras[0].depth(0)


def test_datasets_of_version_2_are_read(tmp_path: Path) -> None:
    made = LerobotSet()
    made.version = "v2.1"
    made.features[WRIST_DEPTH]["video_info"] = made.features[WRIST_DEPTH].pop("info")
    recording = read(made.write(tmp_path / "d"))
    check_frames(recording, tolerance=HALF_STEP)
    np.testing.assert_array_equal(recording.cameras[0].world_from_cameras, POSES[3:])
    assert recording.assumptions["task"] == "task 1"


def test_frames_that_a_video_lacks_are_faults_of_their_own(tmp_path: Path) -> None:
    made = LerobotSet()
    made.columns["timestamp"] = made.columns["timestamp"].copy()
    made.columns["timestamp"][5:] += np.float32(0.05)  # Half an interval: between two frames.
    camera = read(made.write(tmp_path / "d")).cameras[0]
    assert sorted(camera.faults) == [2, 3]
    assert "expected a frame at 0.5500 s" in str(camera.faults[2])
    with pytest.raises(BadData, match="frame 2 of the episode"):
        camera.color(2)
    assert np.abs(camera.color(1).astype(int) - color(4)).max() <= 3


# Poses ----------------------------------------------------------------------------------------------------------------


def with_columns(tmp_path: Path, **columns: np.ndarray) -> Path:
    """A dataset with other columns than the usual one of poses, and without videos."""
    made = LerobotSet()
    del made.columns[COLUMN], made.features[COLUMN]
    for key, images in ((WRIST, color), (WRIST_DEPTH, depth_mm)):
        files = made.files([png(images(i)) for i in range(N_FRAMES)])
        made.replace_video(key, files, dtype="image")
    for name, values in columns.items():
        made.add(name, values)
    return made.write(tmp_path / "d")


def test_a_column_whose_name_says_world_to_camera_is_inverted(tmp_path: Path) -> None:
    inverted = invert_rigid(POSES).reshape(N_FRAMES, 16)
    recording = read(with_columns(tmp_path, **{"observation.camera.wrist_world2cam": inverted}))
    np.testing.assert_allclose(recording.cameras[0].world_from_cameras, POSES[3:], atol=1e-12)
    assert "wrist_world2cam (by its name): camera_from_world" in recording.assumptions["pose"]
    said = read(tmp_path / "d", pose_is="world_from_camera")
    np.testing.assert_allclose(said.cameras[0].world_from_cameras, invert_rigid(POSES[3:]), atol=1e-12)


def test_poses_as_quaternions_and_of_other_names_are_given(tmp_path: Path) -> None:
    quat_wxyz = np.roll(Rotation.from_matrix(POSES[:, :3, :3]).as_quat(), 1, axis=1)
    state = np.concatenate([np.ones((N_FRAMES, 3)), POSES[:, :3, 3], quat_wxyz], axis=1)
    folder = with_columns(tmp_path, **{"observation.state": state})
    with pytest.raises(UsageError, match="poses of wrist: expected one column whose name says world_from_camera"):
        read(folder)
    recording = read(folder, pose_column="observation.state[3:10]", quat="wxyz")
    np.testing.assert_allclose(recording.cameras[0].world_from_cameras, POSES[3:], atol=1e-12)
    with pytest.raises(UsageError, match="a value of observation.state: 0 to 10, got 12"):
        read(folder, pose_column="observation.state[3:12]")
    with pytest.raises(UsageError, match="--pose-column: expected a column of numbers"):
        read(folder, pose_column="pose")


def test_two_columns_of_poses_need_a_choice(tmp_path: Path) -> None:
    poses = POSES.reshape(N_FRAMES, 16)
    folder = with_columns(tmp_path, **{"wrist.world_from_camera": poses, "wrist.base_from_camera": poses})
    with pytest.raises(UsageError, match="got wrist.world_from_camera, wrist.base_from_camera") as error:
        read(folder)
    assert error.value.fix == "pass --pose-column wrist.world_from_camera."
    np.testing.assert_array_equal(
        read(folder, pose_column="wrist.base_from_camera").cameras[0].world_from_cameras, POSES[3:]
    )


def test_a_camera_that_does_not_move_has_its_pose_in_a_file(tmp_path: Path) -> None:
    folder = with_columns(tmp_path)
    np.savetxt(tmp_path / "wrist.txt", POSES[0])
    poses = read(folder, camera_pose=str(tmp_path / "wrist.txt")).cameras[0].world_from_cameras
    np.testing.assert_allclose(poses, np.stack([POSES[0]] * 4), atol=1e-15)


def test_the_grippers_pose_and_hand_eye_calibration_give_the_cameras(tmp_path: Path) -> None:
    quat_xyzw = Rotation.from_matrix(POSES[:, :3, :3]).as_quat()
    state = np.concatenate([POSES[:, :3, 3], quat_xyzw, np.full((N_FRAMES, 1), 0.04)], axis=1).astype(np.float32)
    folder = with_columns(tmp_path, **{"observation.state": state, "action": state})
    hand = POSES[1]
    np.savetxt(tmp_path / "hand.txt", hand)
    options = {"gripper_from_camera": str(tmp_path / "hand.txt")}
    with pytest.raises(UsageError, match="--gripper-from-camera: expected poses of the gripper"):
        read(folder, **options)
    told = read(folder, **options, gripper_pose="observation.state[0:7]", gripper_width="observation.state[7]")
    np.testing.assert_allclose(told.cameras[0].world_from_cameras, POSES[3:] @ hand, atol=1e-6)
    np.testing.assert_allclose(told.robot.world_from_gripper, POSES[3:], atol=1e-6)
    np.testing.assert_allclose(told.robot.gripper_width, 0.04, atol=1e-8)
    np.testing.assert_array_equal(told.robot.action, state[3:])
    info = json.loads((folder / "meta/info.json").read_text())
    names = [f"ee.{name}" for name in ("x", "y", "z", "qx", "qy", "qz", "qw")]
    info["features"]["observation.state"]["names"] = {"motors": [*names, "gripper.width"]}
    (folder / "meta/info.json").write_text(json.dumps(info))
    by_name = read(folder, **options)
    np.testing.assert_array_equal(by_name.cameras[0].world_from_cameras, told.cameras[0].world_from_cameras)
    assert by_name.assumptions["gripper width"] == "observation.state[7], metres"
    part = read(folder, **options, gripper_pose="observation.state[ee.x:gripper.width]")
    np.testing.assert_array_equal(part.robot.world_from_gripper, told.robot.world_from_gripper)


def test_six_numbers_of_a_pose_are_a_rotation_vector_only_if_said(tmp_path: Path) -> None:
    rotvec = Rotation.from_matrix(POSES[:, :3, :3]).as_rotvec()
    state = np.concatenate([POSES[:, :3, 3], rotvec], axis=1)
    folder = with_columns(tmp_path, **{"observation.state": state, COLUMN: POSES.reshape(-1, 16)})
    with pytest.raises(UsageError, match="--gripper-pose: expected 7 or 12 or 16 numbers, got 6") as error:
        read(folder, gripper_pose="observation.state")
    assert "--gripper-rotation rotvec" in error.value.fix
    robot = read(folder, gripper_pose="observation.state", gripper_rotation="rotvec").robot
    np.testing.assert_allclose(robot.world_from_gripper, POSES[3:], atol=1e-12)


# Intrinsics and cameras -----------------------------------------------------------------------------------------------


def test_intrinsics_are_found_in_columns_in_the_list_of_episodes_and_else_asked_for(tmp_path: Path) -> None:
    poses = POSES.reshape(N_FRAMES, 16)
    with pytest.raises(UsageError, match="--intrinsics: expected fx,fy,cx,cy or a file for wrist, got nothing"):
        read(with_columns(tmp_path / "a", **{COLUMN: poses}), intrinsics="")
    zoomed = np.tile(K.reshape(9), (N_FRAMES, 1))
    zoomed[:, 0] += np.arange(N_FRAMES)
    folder = with_columns(tmp_path / "b", **{COLUMN: poses, "observation.camera.wrist.intrinsics": zoomed})
    np.testing.assert_array_equal(read(folder, intrinsics="").cameras[0].lens.K, zoomed[3:].reshape(4, 3, 3))
    np.testing.assert_array_equal(read(folder).cameras[0].lens.K, K)
    made = LerobotSet()
    made.episodes["calibration/wrist_intrinsics"] = [K.reshape(9).tolist()] * 2
    np.testing.assert_array_equal(read(made.write(tmp_path / "c"), intrinsics="").cameras[0].lens.K, K)


def test_cameras_are_paired_by_name_and_those_without_depth_are_named(tmp_path: Path) -> None:
    made = LerobotSet()
    poses = POSES.reshape(N_FRAMES, 16)
    del made.columns[COLUMN], made.features[COLUMN]
    color_files = made.files([png(color(i)) for i in range(N_FRAMES)])
    depth_files = made.files([png(depth_mm(i)) for i in range(N_FRAMES)])
    made.replace_video(WRIST, color_files, dtype="image")
    made.replace_video(WRIST_DEPTH, depth_files, dtype="image")
    for key in ("observation.images.cam_top.rgb", "observation.images.side"):
        made.columns[key], made.features[key] = color_files, feature("image", [3, 32, 48])
    key = "observation.images.cam_top.depth"
    made.columns[key], made.features[key] = depth_files, feature("image", [1, 32, 48])
    made.add("wrist.world_from_camera", poses)
    made.add("top_world_to_camera", invert_rigid(POSES).reshape(N_FRAMES, 16))
    folder = made.write(tmp_path / "d")
    options = {"intrinsics": f"wrist={INTRINSICS};cam_top_rgb=50,50,23.5,15.5"}
    recording = read(folder, **options)
    assert [camera.name for camera in recording.cameras] == ["wrist", "cam_top_rgb"]
    np.testing.assert_allclose(recording.cameras[1].world_from_cameras, POSES[3:], atol=1e-12)
    assert recording.cameras[1].lens.K[0, 0] == 50
    assert recording.assumptions["cameras"] == "side left out: no depth, or not asked for"
    assert [camera.name for camera in read(folder, cameras=("wrist",)).cameras] == ["wrist"]
    with pytest.raises(UsageError, match="expected a camera with colour and depth, got no depth of side"):
        read(folder, cameras=("side",))
    with pytest.raises(UsageError, match="--cameras: expected cameras among wrist, cam_top_rgb, side, got front"):
        read(folder, cameras=("front",))
    with pytest.raises(UsageError, match="--intrinsics: expected NAME=VALUE;NAME=VALUE for wrist, cam_top_rgb"):
        read(folder)
    with pytest.raises(UsageError, match="one camera in the hand, got none without poses"):
        read(folder, **options, gripper_from_camera="hand.txt")


# Files from strangers -------------------------------------------------------------------------------------------------


def changed(filmed: Path, tmp_path: Path, **fields: object) -> Path:
    """The filmed dataset with another `meta/info.json`."""
    for name in ("data", "videos"):
        (tmp_path / name).symlink_to(filmed / name)
    (tmp_path / "meta").mkdir()
    (tmp_path / "meta/episodes").symlink_to(filmed / "meta/episodes")
    info = json.loads((filmed / "meta/info.json").read_text()) | fields
    (tmp_path / "meta/info.json").write_text(json.dumps(info))
    return tmp_path


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"storage_format": "lance"}, "storage: expected Parquet and mp4, got Lance tables"),
        ({"codebase_version": "v1.6"}, "codebase_version: expected v2.0, v2.1 or v3.0, got v1.6"),
        ({"fps": "10"}, "fps: expected a number"),
        ({"features": []}, "features: expected features by name"),
        ({"features": {"a": {"dtype": "video", "shape": [[]]}}}, "features.a: expected a dtype and a shape"),
        ({"data_path": "../{chunk_index}"}, "data_path: expected a path inside the source folder"),
        ({"data_path": "{chunk_index.__class__}"}, "data_path: expected places as"),
        ({"data_path": "{secret:03d}"}, "data_path: expected places of chunk_index, file_index"),
        ({"video_path": "/{video_key}"}, "video_path: expected a path inside the source folder"),
        ({"video_path": None}, "video_path: expected the template of a path"),
        ({"data_path": "meta/info.json"}, "info.json: expected a readable Parquet file"),
    ],
)
def test_what_a_dataset_says_of_itself_is_checked(
    filmed: Path, tmp_path: Path, fields: dict[str, object], message: str
) -> None:
    with pytest.raises(BadData, match=message):
        read(changed(filmed, tmp_path, **fields), follow_links=True)


def test_lance_tables_beside_meta_are_refused(filmed: Path, tmp_path: Path) -> None:
    (changed(filmed, tmp_path) / "frames.lance").mkdir()
    with pytest.raises(BadData, match="got Lance tables"):
        read(tmp_path, follow_links=True)


def test_tables_that_do_not_belong_to_the_list_of_episodes_are_refused(filmed: Path, tmp_path: Path) -> None:
    folder = changed(filmed, tmp_path)
    table = pq.read_table(filmed / "data/chunk-000/file-000.parquet")
    (folder / "data").unlink()
    (folder / "data/chunk-000").mkdir(parents=True)
    pq.write_table(table.slice(0, 5), folder / "data/chunk-000/file-000.parquet")
    with pytest.raises(BadData, match="expected 4 rows of episode 1, one after another, got 2"):
        read(folder, follow_links=True)


def test_a_folder_without_a_dataset_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadData, match="meta/info.json: LeRobot dataset: expected a file"):
        read(tmp_path)
