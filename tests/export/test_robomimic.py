from __future__ import annotations

import json
from pathlib import Path

import h5py
import numpy as np
import pytest

from bask_data.dataset import Dataset
from bask_data.export import ExportSettings, export
from bask_data.formats import FORMATS
from bask_data.formats.options.robomimic import RobomimicOptions
from bask_data.kinds import Demonstration
from bask_data.sources.ingest import ingest
from tests.export.encoded import ACTIONS, Demo, picture, seen_demo

FORMAT = next(format for format in FORMATS if format.name == "robomimic")


@pytest.fixture(scope="module")
def file(encoded, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("robomimic") / "out.hdf5"
    export(encoded[0], out, "robomimic", ExportSettings(videos=True, validation=("a",), test=("b",)))
    return out


def test_every_value_of_every_frame_is_read_back(encoded, file: Path) -> None:
    with h5py.File(file) as read:
        assert sorted(read["data"]) == ["demo_0", "demo_1", "demo_2"]
        for i, name in enumerate(("c", "a", "b")):
            demo, group = encoded[1][name], read[f"data/demo_{i}"]
            n, obs = len(demo.mean), group["obs"]
            assert (group.attrs["num_samples"], group.attrs["name"]) == (n, name)
            np.testing.assert_allclose(group["actions"], demo.robot.action, rtol=1e-6)
            np.testing.assert_array_equal(group["time"], demo.time)
            np.testing.assert_array_equal(obs["keypoints"][:].reshape(n, 2, 3), demo.mean)
            spread = np.sqrt(np.einsum("tkii->tk", demo.covariance))
            np.testing.assert_allclose(obs["spread"], spread, rtol=1e-6)
            np.testing.assert_array_equal(obs["observed"], demo.observed["wrist"] | demo.observed["overhead"])
            np.testing.assert_array_equal(obs["localised"], np.ones((n, 2)))
            gripper = demo.robot.world_from_gripper
            np.testing.assert_allclose(obs["gripper_position"], gripper[:, :3, 3], rtol=1e-6)
            np.testing.assert_allclose(obs["gripper_rotation"][:, 3:], gripper[:, :3, 1], atol=1e-7)
            np.testing.assert_allclose(obs["gripper_width"][:, 0], demo.robot.gripper_width, rtol=1e-6)
            for camera in ("wrist", "overhead"):
                images = np.stack([picture(j, camera) for j in range(n)])
                np.testing.assert_array_equal(obs[f"{camera}_image"], images)


def test_a_demonstrations_only_reward_is_in_its_last_frame(file: Path) -> None:
    with h5py.File(file) as read:
        for group in read["data"].values():
            n = group.attrs["num_samples"]
            assert group["rewards"][:].tolist() == group["dones"][:].tolist() == [0.0] * (n - 1) + [1.0]
            assert group["states"].shape == (n, 0)


def test_splits_are_lists_of_names_as_robomimic_decodes_them(file: Path) -> None:
    with h5py.File(file) as read:
        masks = {name: [text.decode("utf-8") for text in np.array(read[f"mask/{name}"][:])] for name in read["mask"]}
    assert masks == {"train": ["demo_0"], "valid": ["demo_1"], "test": ["demo_2"]}


def test_the_file_states_its_number_of_frames_and_no_environment(file: Path) -> None:
    with h5py.File(file) as read:
        assert read["data"].attrs["total"] == 28
        environment = json.loads(read["data"].attrs["env_args"])
        assert (environment["env_name"], environment["type"], environment["env_kwargs"]) == ("kitchen", 2, {})
        assert [name.decode() for name in read["data/demo_0/actions"].attrs["values"]] == list(ACTIONS)
        assert read["data/demo_0/obs/spread"].attrs["units"] == "metre"


def test_observations_are_32_bit_floats_or_images(file: Path) -> None:
    with h5py.File(file) as read:
        kinds = {name: values.dtype for name, values in read["data/demo_0/obs"].items()}
    assert {name for name, dtype in kinds.items() if dtype == np.uint8} == {"wrist_image", "overhead_image"}
    assert {dtype for name, dtype in kinds.items() if not name.endswith("_image")} == {np.dtype(np.float32)}


def test_actions_out_of_robomimics_range_are_noted(tmp_path: Path) -> None:
    dataset, demo = Dataset.create(tmp_path / "d"), Demo()
    demo.robot.action[2, 1] = -3.5
    demo.publish(dataset, "a")
    assert export(dataset, tmp_path / "out.hdf5", "robomimic", ExportSettings()).notes == [
        "robomimic expects actions from -1 to 1; the largest magnitude is 3.5."
    ]


def test_what_cameras_adds_comes_back_with_the_same_numbers(tmp_path: Path) -> None:
    dataset = Dataset.create(tmp_path / "d")
    demos = {"a": seen_demo(0), "b": seen_demo(1)}
    demos["b"].origin = (400_000.0, 5_000_000.0, 200.0)
    for name, demo in demos.items():
        demo.publish(dataset, name)
    export(dataset, tmp_path / "out.hdf5", "robomimic", ExportSettings(cameras=True))
    again = Dataset.create(tmp_path / "again")
    for i, (name, demo) in enumerate(demos.items()):
        options = RobomimicOptions(episode=f"demo_{i}")
        ingest(again.root, name, format=FORMAT, source=tmp_path / "out.hdf5", options=options, kind="demonstration")
        read = Demonstration(again.path(Demonstration, name))
        before = Demonstration(dataset.path(Demonstration, name))
        camera, original = read.camera("wrist"), before.camera("wrist")
        assert camera.depth_scale == original.depth_scale
        for frame in range(camera.n_frames):
            np.testing.assert_array_equal(camera.rgb(frame), original.rgb(frame))
            np.testing.assert_array_equal(camera.depth_raw(frame), original.depth_raw(frame))
        np.testing.assert_array_equal(camera.Ks, original.Ks)
        np.testing.assert_array_equal(camera.time, original.time)
        shift = np.subtract(demo.origin, read.metadata.origin)
        moved = original.world_from_cameras.copy()
        moved[:, :3, 3] += shift
        np.testing.assert_allclose(camera.world_from_cameras, moved, atol=1e-9)
        assert read.robot is not None and demo.robot is not None
        np.testing.assert_allclose(read.robot.world_from_gripper[:, :3, :3], demo.robot.world_from_gripper[:, :3, :3])  # type: ignore[index]
        np.testing.assert_array_equal(read.robot.gripper_width, demo.robot.gripper_width)
        np.testing.assert_array_equal(read.robot.action, demo.robot.action)
        assert read.robot.action_names == ACTIONS


def test_robomimic_finds_depth_and_camera_info_where_it_writes_them(tmp_path: Path) -> None:
    dataset, demo = Dataset.create(tmp_path / "d"), seen_demo()
    demo.cameras = ("robot0_eye_in_hand", "agentview")
    demo.observed = dict.fromkeys(demo.cameras, demo.observed["wrist"])
    demo.publish(dataset, "a")
    export(dataset, tmp_path / "out.hdf5", "robomimic", ExportSettings(cameras=True))
    with h5py.File(tmp_path / "out.hdf5") as read:
        group = read["data/demo_0"]
        depth = group["obs/agentview_depth"]
        assert (depth.shape, depth.dtype) == ((len(demo.time), *demo.size, 1), np.float32)
        np.testing.assert_allclose(depth[2, ..., 0], demo.depth[2] * demo.depth_scale, rtol=1e-6)
        info = json.loads(group.attrs["camera_info"])
    np.testing.assert_array_equal(info["agentview"]["extrinsics"], demo.world_from_cameras[0])
    np.testing.assert_array_equal(info["agentview"]["intrinsics"], demo.K[0])
    gripper = demo.robot.world_from_gripper[0]  # type: ignore[union-attr, index]
    hand = np.array(info["robot0_eye_in_hand"]["extrinsics"])
    np.testing.assert_allclose(hand @ gripper, demo.world_from_cameras[0], atol=1e-12)
