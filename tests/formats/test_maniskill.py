from __future__ import annotations

import json
from pathlib import Path

import h5py
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bask_data.errors import BadData, UsageError
from bask_data.formats import FORMATS
from bask_data.formats.options.maniskill import ManiskillOptions
from bask_data.formats.recording import PreparedRecording
from tests.formats.folders import HEIGHT, WIDTH, K, images, rigid

N = 4
POSES = np.stack([rigid(np.random.default_rng(i)) for i in range(N)])
GRIPPERS = np.stack([rigid(np.random.default_rng(100 + i)) for i in range(N)])
ACTIONS = np.random.default_rng(0).normal(size=(N - 1, 7)).astype(np.float32)
MANISKILL = next(format for format in FORMATS if format.name == "maniskill")


def read(source: Path, **options: object) -> PreparedRecording:
    return MANISKILL.read(source, ManiskillOptions(**options))


def write_camera(
    observations: h5py.Group, name: str, groups: tuple[str, str] = ("sensor_data", "sensor_param")
) -> None:
    """Images and calibration as ManiSkill's RecordEpisode writes them."""
    color, depth = images(N)
    shown = observations.create_group(f"{groups[0]}/{name}")
    shown.create_dataset("rgb", data=color, compression="gzip", compression_opts=5)
    shown.create_dataset("depth", data=depth[..., None].astype(np.int16), compression="gzip", compression_opts=5)
    known = observations.create_group(f"{groups[1]}/{name}")
    known["extrinsic_cv"] = np.linalg.inv(POSES)[:, :3].astype(np.float32)
    known["cam2world_gl"] = (POSES @ np.diag([1.0, -1, -1, 1])).astype(np.float32)
    known["intrinsic_cv"] = np.tile(K, (N, 1, 1)).astype(np.float32)


def written(path: Path, n_trajectories: int = 1, cameras: tuple[str, ...] = ("hand_camera",)) -> Path:
    with h5py.File(path, "w") as file:
        for k in range(n_trajectories):
            observations = file.create_group(f"traj_{k}/obs", track_order=True)
            for name in cameras:
                write_camera(observations, name)
            quat_wxyz = np.roll(Rotation.from_matrix(GRIPPERS[:, :3, :3]).as_quat(), 1, axis=1)
            observations["extra/tcp_pose"] = np.hstack([GRIPPERS[:, :3, 3], quat_wxyz]).astype(np.float32)
            observations["agent/qpos"] = np.full((N, 9), 0.03, np.float32)
            file[f"traj_{k}/actions"] = ACTIONS + k
    return path


def test_a_trajectory_is_read_in_our_axes_and_metres(tmp_path: Path) -> None:
    recording = read(written(tmp_path / "a.h5"))
    [camera] = recording.cameras
    color, depth = images(N)
    assert (camera.name, camera.n_frames, camera.depth_scale) == ("hand_camera", N, 0.001)
    np.testing.assert_array_equal(camera.K, K)
    np.testing.assert_allclose(camera.world_from_cameras, POSES, atol=1e-6)
    np.testing.assert_allclose(camera.time, np.arange(N) / 20)
    for i in range(N):
        rgb, raw = camera.read(i)
        np.testing.assert_array_equal(rgb, color[i])
        np.testing.assert_array_equal(raw, depth[i])
    robot = recording.robot
    assert robot is not None and robot.action is not None
    np.testing.assert_allclose(robot.world_from_gripper, GRIPPERS, atol=1e-6)
    np.testing.assert_allclose(robot.gripper_width, np.full(N, 0.06), rtol=1e-6)
    np.testing.assert_array_equal(robot.action, np.concatenate([ACTIONS, ACTIONS[-1:]]))
    assert "the last observation has none: that before it is repeated (--frames :3)" in recording.assumptions["robot"]
    assert len(read(tmp_path / "a.h5", frames=":3").robot.action) == 3  # type: ignore[union-attr, arg-type]


def test_the_json_file_beside_states_rate_and_control_mode(tmp_path: Path) -> None:
    source = written(tmp_path / "a.h5")
    kwargs = {"control_mode": "pd_ee_delta_pose", "sim_config": {"control_freq": 10}}
    (tmp_path / "a.json").write_text(json.dumps({"env_info": {"env_kwargs": kwargs}, "episodes": []}))
    recording = read(source)
    np.testing.assert_allclose(recording.cameras[0].time, np.arange(N) / 10)
    assert recording.robot is not None and recording.robot.action_names is not None
    assert recording.robot.action_names[0] == "dx" and len(recording.files) == 2
    (tmp_path / "a.json").write_text("{")
    with pytest.raises(BadData, match=r"a\.json: content: expected JSON"):
        read(source)


def test_trajectories_and_cameras_are_chosen(tmp_path: Path) -> None:
    source = written(tmp_path / "a.h5", 11, ("base_camera", "hand_camera"))
    assert MANISKILL.episodes(source, ManiskillOptions())[9:] == ("traj_9", "traj_10")
    with pytest.raises(UsageError, match="--episode: expected one of traj_0, .*, got none, but the source holds 11"):
        read(source)
    recording = read(source, episode="10", cameras=("hand_camera",))
    assert [camera.name for camera in recording.cameras] == ["hand_camera"]
    np.testing.assert_allclose(recording.robot.action[0], ACTIONS[0] + 10)  # type: ignore[union-attr, index]
    assert [camera.name for camera in read(source, episode="traj_3").cameras] == ["base_camera", "hand_camera"]


def test_depth_beyond_the_reach_of_16_bits_is_no_measurement(tmp_path: Path) -> None:
    with h5py.File(written(tmp_path / "a.h5"), "a") as file:
        file["traj_0/obs/sensor_data/hand_camera/depth"][1, 2, 3] = -5
    assert read(tmp_path / "a.h5").cameras[0].read(1)[1][2, 3] == 0


def test_version_2_has_other_groups_and_units(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        write_camera(file.create_group("traj_0/obs"), "base_camera", ("image", "camera_param"))
        known = file["traj_0/obs/camera_param/base_camera"]
        del known["extrinsic_cv"], known["cam2world_gl"]
        known["extrinsic_cv"] = np.linalg.inv(POSES)
    recording = read(tmp_path / "a.h5")
    [camera] = recording.cameras
    assert camera.depth_scale == 1 / 1024
    np.testing.assert_allclose(camera.world_from_cameras, POSES, atol=1e-12)
    assert recording.robot is not None and recording.robot.action is None


def test_cameras_without_colour_and_depth_are_named(tmp_path: Path) -> None:
    source = written(tmp_path / "a.h5", 1, ("base_camera", "hand_camera"))
    with h5py.File(source, "a") as file:
        shown = file["traj_0/obs/sensor_data/base_camera"]
        del shown["rgb"], shown["depth"]
        shown["Color"] = np.zeros((N, HEIGHT, WIDTH, 4), np.uint8)
    recording = read(source)
    assert [camera.name for camera in recording.cameras] == ["hand_camera"]
    assert "left out: base_camera (no rgb, depth: raw Color and Position" in recording.assumptions["cameras"]


def test_a_trajectory_without_images_is_refused_with_the_way_to_get_them(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["traj_0/actions"] = ACTIONS
    with pytest.raises(BadData, match="traj_0/obs: expected images, in sensor_data, got no obs.*--obs-mode rgbd"):
        read(tmp_path / "a.h5")
    with h5py.File(tmp_path / "b.h5", "w") as file:
        file["data/demo_0/actions"] = ACTIONS
    with pytest.raises(BadData, match="expected trajectories traj_0, traj_1, ..., got data"):
        read(tmp_path / "b.h5")


def test_two_statements_of_a_pose_must_agree(tmp_path: Path) -> None:
    with h5py.File(written(tmp_path / "a.h5"), "a") as file:
        file["traj_0/obs/sensor_param/hand_camera/cam2world_gl"][2, 0, 3] += 0.01
    with pytest.raises(BadData, match="hand_camera frame 2: expected cam2world_gl and extrinsic_cv of the same pose"):
        read(tmp_path / "a.h5")


def test_segmentation_is_truth_for_the_objects_that_are_named(tmp_path: Path) -> None:
    numbers = np.zeros((N, HEIGHT, WIDTH, 1), np.int16)
    numbers[:, 3:6], numbers[:, 6:] = 17, 3
    with h5py.File(written(tmp_path / "a.h5"), "a") as file:
        file["traj_0/obs/sensor_data/hand_camera/segmentation"] = numbers
    assert not read(tmp_path / "a.h5").has_labels
    recording = read(tmp_path / "a.h5", objects="17=cube")
    labels = recording.cameras[0].labels
    assert labels is not None and recording.label_names == {1: "cube"}
    np.testing.assert_array_equal(labels(0)[:, 0], [0] * 3 + [1] * 3 + [0] * (HEIGHT - 6))


def test_images_from_other_files_are_refused(tmp_path: Path) -> None:
    written(tmp_path / "secret.h5")
    with h5py.File(written(tmp_path / "a.h5"), "a") as file:
        shown = file["traj_0/obs/sensor_data/hand_camera"]
        del shown["rgb"]
        shown["rgb"] = h5py.ExternalLink("secret.h5", "traj_0/obs/sensor_data/hand_camera/rgb")
    with pytest.raises(BadData, match="rgb: expected an object inside this file"):
        read(tmp_path / "a.h5")
