from __future__ import annotations

import json
from pathlib import Path

import h5py
import numpy as np
import pytest

from bask_data.dataset import Dataset
from bask_data.export import ExportSettings, export
from tests.export.encoded import ACTIONS, Demo, picture


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
