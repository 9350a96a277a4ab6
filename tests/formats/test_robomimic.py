from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bask_data.errors import BadData, UsageError
from bask_data.formats import FORMATS
from bask_data.formats.options.robomimic import RobomimicOptions
from bask_data.formats.recording import PreparedRecording
from tests.formats.folders import K, images, rigid

N = 4
GRIPPERS = np.stack([rigid(np.random.default_rng(i)) for i in range(N)])
GRIPPER_FROM_CAMERA = rigid(np.random.default_rng(50))
FIXED = rigid(np.random.default_rng(51))
ACTIONS = np.random.default_rng(0).uniform(-1, 1, (N, 7))
HAND = "robot0_eye_in_hand"
ROBOMIMIC = next(format for format in FORMATS if format.name == "robomimic")
QUARTER = Rotation.from_euler("z", 90, degrees=True).as_matrix()


def read(source: Path, **options: object) -> PreparedRecording:
    return ROBOMIMIC.read(source, RobomimicOptions(**options))


def extrinsics(camera: str) -> np.ndarray:
    """As robomimic's `get_camera_info` computes them."""
    if "eye_in_hand" not in camera:
        return FIXED
    return GRIPPERS[0] @ GRIPPER_FROM_CAMERA @ np.linalg.inv(GRIPPERS[0])


def metres() -> np.ndarray:
    """Depth (n, h, w, 1) as robomimic writes it: what was not hit is at the far plane."""
    depth = images(N)[1].astype(np.float32)[..., None] / 1000
    return np.where(depth > 0, depth, np.float32(50))


def written(path: Path, cameras: tuple[str, ...] = (HAND,), n_demos: int = 1, **env_kwargs: Any) -> Path:
    color, _ = images(N)
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        data.attrs["env_args"] = json.dumps({"env_name": "Lift", "type": 1, "env_kwargs": env_kwargs})
        for i in range(n_demos):
            demo = data.create_group(f"demo_{i}")
            info = {name: {"intrinsics": K.tolist(), "extrinsics": extrinsics(name).tolist()} for name in cameras}
            demo.attrs["camera_info"] = json.dumps(info, indent=4)
            demo["actions"] = ACTIONS + i
            obs = demo.create_group("obs")
            for name in cameras:
                obs.create_dataset(f"{name}_image", data=color, compression="gzip")
                obs.create_dataset(f"{name}_depth", data=metres(), compression="gzip")
            obs["robot0_eef_pos"] = GRIPPERS[:, :3, 3]
            obs["robot0_eef_quat_site"] = Rotation.from_matrix(GRIPPERS[:, :3, :3]).as_quat()
            obs["robot0_eef_quat"] = Rotation.from_matrix(GRIPPERS[:, :3, :3] @ QUARTER.T).as_quat()
            obs["robot0_gripper_qpos"] = np.tile([0.03, -0.02], (N, 1))
        file["mask/train"] = np.array([b"demo_0"])
    return path


def test_a_camera_in_the_hand_moves_with_the_site_of_the_gripper(tmp_path: Path) -> None:
    recording = read(written(tmp_path / "a.hdf5"))
    [camera] = recording.cameras
    assert (camera.name, camera.n_frames) == (HAND, N)
    np.testing.assert_array_equal(camera.K, K)
    np.testing.assert_allclose(camera.world_from_cameras, GRIPPERS @ GRIPPER_FROM_CAMERA, atol=1e-9)
    color, depth = images(N)
    for i in range(N):
        rgb, raw = camera.read(i)
        np.testing.assert_array_equal(rgb, color[i])
        np.testing.assert_allclose(raw * camera.depth_scale, depth[i] / 1000, atol=1e-6)
    robot = recording.robot
    assert robot is not None
    np.testing.assert_allclose(robot.world_from_gripper, GRIPPERS, atol=1e-9)
    np.testing.assert_allclose(robot.gripper_width, np.full(N, 0.05))
    np.testing.assert_array_equal(robot.action, ACTIONS)


def test_extrinsics_of_a_fixed_camera_are_its_pose(tmp_path: Path) -> None:
    recording = read(written(tmp_path / "a.hdf5", ("agentview", HAND)))
    assert [camera.name for camera in recording.cameras] == ["agentview", HAND]
    np.testing.assert_allclose(recording.cameras[0].world_from_cameras, np.tile(FIXED, (N, 1, 1)), atol=1e-12)
    assert [camera.name for camera in read(tmp_path / "a.hdf5", cameras=("agentview",)).cameras] == ["agentview"]


def test_extrinsics_may_be_the_cameras_pose_in_the_gripper(tmp_path: Path) -> None:
    with h5py.File(written(tmp_path / "a.hdf5"), "a") as file:
        info = {HAND: {"intrinsics": K.tolist(), "extrinsics": GRIPPER_FROM_CAMERA.tolist()}}
        file["data/demo_0"].attrs["camera_info"] = json.dumps(info)
    [camera] = read(tmp_path / "a.hdf5", hand_extrinsics="gripper_from_camera").cameras
    np.testing.assert_allclose(camera.world_from_cameras, GRIPPERS @ GRIPPER_FROM_CAMERA, atol=1e-9)


def test_without_the_sites_rotation_its_turn_must_be_stated(tmp_path: Path) -> None:
    with h5py.File(written(tmp_path / "a.hdf5"), "a") as file:
        del file["data/demo_0/obs/robot0_eef_quat_site"]
    with pytest.raises(BadData, match="no robot0_eef_quat_site, the pose of the hand .*--site-turn 90"):
        read(tmp_path / "a.hdf5")
    [camera] = read(tmp_path / "a.hdf5", site_turn=90).cameras
    np.testing.assert_allclose(camera.world_from_cameras, GRIPPERS @ GRIPPER_FROM_CAMERA, atol=1e-9)


def test_the_gripper_of_a_file_without_the_site_is_the_hands_body(tmp_path: Path) -> None:
    with h5py.File(written(tmp_path / "a.hdf5", ("agentview",)), "a") as file:
        del file["data/demo_0/obs/robot0_eef_quat_site"]
    recording = read(tmp_path / "a.hdf5")
    gripper = recording.robot.world_from_gripper  # type: ignore[union-attr]
    np.testing.assert_allclose(gripper[:, :3, :3], GRIPPERS[:, :3, :3] @ QUARTER.T, atol=1e-9)  # type: ignore[index]
    assert "rotation of the hand's body" in recording.assumptions["robot"]


def test_cameras_without_depth_or_calibration_are_named(tmp_path: Path) -> None:
    with h5py.File(written(tmp_path / "a.hdf5", ("agentview", HAND)), "a") as file:
        del file["data/demo_0/obs/agentview_depth"]
    assert "left out: agentview (no agentview_depth" in read(tmp_path / "a.hdf5").assumptions["cameras"]
    with h5py.File(tmp_path / "a.hdf5", "a") as file:
        del file["data/demo_0"].attrs["camera_info"]
    with pytest.raises(BadData, match="robot0_eye_in_hand: no camera_info: extract the observations .* --depth"):
        read(tmp_path / "a.hdf5")


def test_demonstrations_are_chosen_by_name_or_number(tmp_path: Path) -> None:
    source = written(tmp_path / "a.hdf5", n_demos=11)
    assert ROBOMIMIC.episodes(source, RobomimicOptions())[9:] == ("demo_9", "demo_10")
    recording = read(source, episode="10")
    np.testing.assert_array_equal(recording.robot.action, ACTIONS + 10)  # type: ignore[union-attr]
    with pytest.raises(UsageError, match="--episode: expected one of demo_0, demo_1, .*, got none"):
        read(source)


def test_times_are_those_of_the_control_frequency(tmp_path: Path) -> None:
    source = written(tmp_path / "a.hdf5", control_freq=10)
    np.testing.assert_allclose(read(source).cameras[0].time, np.arange(N) / 10)
    source = written(tmp_path / "b.hdf5")
    np.testing.assert_allclose(read(source, fps=50).cameras[0].time, np.arange(N) / 50)
    with h5py.File(source, "a") as file:
        file["data/demo_0/time"] = [1.0, 2.0, 4.0, 8.0]
    np.testing.assert_array_equal(read(source).cameras[0].time, [1, 2, 4, 8])


def test_normalised_depth_unit_recognised_and_converted_with_its_planes(tmp_path: Path) -> None:
    near, far = 0.01, 50.0
    with h5py.File(written(tmp_path / "a.hdf5"), "a") as file:
        depth = file[f"data/demo_0/obs/{HAND}_depth"]
        depth[...] = (1 - near / depth[...].astype(np.float64)) / (1 - near / far)
    with pytest.raises(BadData, match="_depth: expected depth in metres, got values up to 1 with a median of 0.9"):
        read(tmp_path / "a.hdf5")
    [camera] = read(tmp_path / "a.hdf5", planes="0.01,50").cameras
    np.testing.assert_allclose(camera.read(1)[1] * camera.depth_scale, images(N)[1][1] / 1000, atol=3e-4)
    assert read(tmp_path / "a.hdf5", depth_unit="metres").cameras[0].read(0)[1].max() * camera.depth_scale <= 1
    with pytest.raises(UsageError, match="--planes: expected NEAR,FAR in metres, got 5,1"):
        read(tmp_path / "a.hdf5", planes="5,1")


def test_damaged_camera_info_is_refused(tmp_path: Path) -> None:
    with h5py.File(written(tmp_path / "a.hdf5"), "a") as file:
        file["data/demo_0"].attrs["camera_info"] = json.dumps({HAND: {"intrinsics": [[1, 2], [3]], "extrinsics": 4}})
    with pytest.raises(BadData, match=r"camera_info: robot0_eye_in_hand: intrinsics: expected a 3x3 matrix, got shape"):
        read(tmp_path / "a.hdf5")
    with h5py.File(tmp_path / "a.hdf5", "a") as file:
        huge = json.dumps({HAND: {"intrinsics": [[10**400]], "extrinsics": 4}})
        file["data/demo_0"].attrs["camera_info"] = huge
    with pytest.raises(BadData, match="intrinsics: expected a 3x3 matrix"):
        read(tmp_path / "a.hdf5")
    with h5py.File(tmp_path / "a.hdf5", "a") as file:
        file["data/demo_0"].attrs["camera_info"] = "{"
    with pytest.raises(BadData, match="data/demo_0 attribute camera_info: content: expected JSON"):
        read(tmp_path / "a.hdf5")


def test_frames_must_be_as_many_in_every_array(tmp_path: Path) -> None:
    with h5py.File(written(tmp_path / "a.hdf5"), "a") as file:
        del file["data/demo_0/actions"]
        file["data/demo_0/actions"] = ACTIONS[:2]
    with pytest.raises(BadData, match=r"data/demo_0/actions: expected shape \(4, any\), got \(2, 7\)"):
        read(tmp_path / "a.hdf5")
    with h5py.File(written(tmp_path / "b.hdf5", ("agentview", HAND)), "a") as file:
        for kind in ("image", "depth"):
            short = file[f"data/demo_0/obs/agentview_{kind}"][:2]
            del file[f"data/demo_0/obs/agentview_{kind}"]
            file[f"data/demo_0/obs/agentview_{kind}"] = short
    with pytest.raises(
        BadData, match="frames: expected as many of each camera, got agentview: 2, robot0_eye_in_hand: 4"
    ):
        read(tmp_path / "b.hdf5")
