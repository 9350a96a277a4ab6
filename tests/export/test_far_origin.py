"""Demonstrations far from the origin of their source: positions keep their accuracy in every format."""

from __future__ import annotations

import json
from pathlib import Path

import h5py
import numpy as np
import pyarrow.parquet as pq
import pytest
import zarr

from bask_data.dataset import Dataset
from bask_data.export import ExportSettings, export
from tests.export.encoded import Demo

ORIGINS = {"a": (441547.25, 5121946.5, 245.0), "b": (441549.25, 5121945.5, 245.5)}
FIRST = np.array(ORIGINS["a"])


@pytest.fixture(scope="module")
def far(tmp_path_factory: pytest.TempPathFactory) -> tuple[Dataset, dict[str, Demo]]:
    """Two demonstrations with origins 2 m apart."""
    dataset = Dataset.create(tmp_path_factory.mktemp("far") / "kitchen")
    demos = {name: Demo(i, 5) for i, name in enumerate(ORIGINS)}
    for name, demo in demos.items():
        demo.origin = ORIGINS[name]
        demo.publish(dataset, name)
    return dataset, demos


def in_source(demo: Demo) -> tuple[np.ndarray, np.ndarray]:
    """Keypoints (t, 6) and gripper positions (t, 3) in the source's world frame, metres."""
    assert demo.robot is not None and demo.robot.world_from_gripper is not None
    keypoints = demo.mean.astype(np.float64) + demo.origin
    return keypoints.reshape(len(keypoints), 6), demo.robot.world_from_gripper[:, :3, 3] + demo.origin


def near(positions: np.ndarray) -> np.ndarray:
    """Positions (t, 3 k) relative to the first origin."""
    return positions - np.tile(FIRST, positions.shape[1] // 3)


def test_parquet_has_positions_of_the_source_and_near_ones(far, tmp_path: Path) -> None:
    export(far[0], tmp_path / "out", "parquet", ExportSettings())
    table = pq.read_table(tmp_path / "out" / "frames.parquet")
    for i, demo in enumerate(far[1].values()):
        mine = table.slice(5 * i, 5)
        for column, expected in zip(("keypoints", "gripper_position"), in_source(demo), strict=True):
            np.testing.assert_allclose(mine[f"{column}_world"].to_pylist(), expected, rtol=0, atol=1e-8)
            np.testing.assert_allclose(
                mine[column].to_pylist(), expected - np.tile(FIRST, expected.shape[1] // 3), rtol=0, atol=1e-6
            )
    described = json.loads((tmp_path / "out" / "bask.json").read_text())
    assert described["origin"] == FIRST.tolist()


def test_a_policys_observation_is_near_in_every_format_and_the_source_beside(far, tmp_path: Path) -> None:
    for format, suffix in (("lerobot", ""), ("robomimic", ".hdf5"), ("diffusion-policy", ".zarr")):
        export(far[0], tmp_path / f"{format}{suffix}", format, ExportSettings())
    keypoints, grippers = (np.concatenate(parts) for parts in zip(*map(in_source, far[1].values()), strict=True))
    frames = pq.read_table(next((tmp_path / "lerobot" / "data").rglob("*.parquet")))
    replay = zarr.open_group(str(tmp_path / "diffusion-policy.zarr"), mode="r")["data"]
    with h5py.File(tmp_path / "robomimic.hdf5") as file:
        demos = [file[f"data/demo_{i}/obs"] for i in range(2)]
        mimic = {name: np.concatenate([demo[name] for demo in demos]) for name in demos[0]}
    for observed in (
        np.array(frames["observation.state"].to_pylist())[:, :6],
        np.array(frames["observation.environment_state"].to_pylist())[:, :6],
        replay["state"][:, :6],
        mimic["keypoints"],
    ):
        np.testing.assert_allclose(observed, near(keypoints), rtol=0, atol=1e-6)
    for world in (
        np.array(frames["keypoints.world"].to_pylist()),
        replay["keypoints_world"][:],
        mimic["keypoints_world"],
    ):
        np.testing.assert_allclose(world, keypoints, rtol=0, atol=1e-8)
    for world in (
        np.array(frames["gripper_position.world"].to_pylist()),
        replay["gripper_position_world"][:],
        mimic["gripper_position_world"],
    ):
        np.testing.assert_allclose(world, grippers, rtol=0, atol=1e-8)


def test_demonstrations_at_the_origin_have_no_second_positions(encoded, tmp_path: Path) -> None:
    export(encoded[0], tmp_path / "out", "parquet", ExportSettings(only=("a", "c")))
    assert not [name for name in pq.read_schema(tmp_path / "out" / "frames.parquet").names if "world" in name]
