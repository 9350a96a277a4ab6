from __future__ import annotations

import json
from pathlib import Path

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from bask_data.export import ExportSettings, export
from tests.export.encoded import ACTIONS, picture


@pytest.fixture(scope="module")
def folder(encoded, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("parquet") / "out"
    export(encoded[0], out, "parquet", ExportSettings(videos=True, validation=("b",)))
    return out


def column(table: pa.Table, name: str) -> np.ndarray:
    return np.array(table[name].to_pylist())


def test_every_value_of_every_frame_is_read_back(encoded, folder: Path) -> None:
    table = pq.read_table(folder / "frames.parquet")
    at = 0
    for name, split in (("a", "train"), ("c", "train"), ("b", "validation")):
        demo = encoded[1][name]
        n = len(demo.mean)
        mine, at = table.slice(at, n), at + n
        assert set(mine["episode"].to_pylist()) == {name} and set(mine["split"].to_pylist()) == {split}
        assert mine["frame"].to_pylist() == list(range(n))
        np.testing.assert_array_equal(column(mine, "time"), demo.time)
        np.testing.assert_array_equal(column(mine, "keypoints").reshape(n, 2, 3), demo.mean)
        spread = np.sqrt(np.einsum("tkii->tk", demo.covariance))
        np.testing.assert_allclose(column(mine, "spread"), spread, rtol=1e-6)
        np.testing.assert_array_equal(column(mine, "observed"), demo.observed["wrist"] | demo.observed["overhead"])
        assert column(mine, "localised").all()
        gripper = demo.robot.world_from_gripper
        np.testing.assert_allclose(column(mine, "gripper_position"), gripper[:, :3, 3], rtol=1e-6)
        rotation = np.concatenate([gripper[:, :3, 0], gripper[:, :3, 1]], axis=1)
        np.testing.assert_allclose(column(mine, "gripper_rotation"), rotation, atol=1e-7)
        np.testing.assert_allclose(column(mine, "gripper_width")[:, 0], demo.robot.gripper_width, rtol=1e-6)
        np.testing.assert_allclose(column(mine, "action"), demo.robot.action, rtol=1e-6)
    assert at == table.num_rows


def test_columns_name_their_values_and_units(folder: Path) -> None:
    schema = pq.read_schema(folder / "frames.parquet")
    action = schema.field("action").metadata
    assert json.loads(action[b"values"]) == list(ACTIONS)
    assert schema.field("keypoints").metadata[b"units"] == b"metre"
    assert schema.field("keypoints").type == pa.list_(pa.float32(), 6)
    assert json.loads(schema.metadata[b"bask"]) == json.loads((folder / "bask.json").read_text())


def test_a_demonstration_is_a_row_group(folder: Path) -> None:
    file = pq.ParquetFile(folder / "frames.parquet")
    groups = [file.read_row_group(i, columns=["episode"])["episode"].to_pylist() for i in range(file.num_row_groups)]
    assert groups == [["a"] * 12, ["c"] * 9, ["b"] * 7]


def test_episodes_are_listed_with_their_rate_and_split(folder: Path) -> None:
    rows = pq.read_table(folder / "episodes.parquet").to_pylist()
    assert [(row["name"], row["split"], row["task"], row["n_frames"]) for row in rows] == [
        ("a", "train", "put the lid on", 12),
        ("c", "train", "put the lid on", 9),
        ("b", "validation", "stir", 7),
    ]
    assert rows[0]["fps"] == pytest.approx(10.0)


def test_each_camera_has_a_video_of_each_demonstration(folder: Path) -> None:
    assert len(list(folder.glob("videos/*/*.mp4"))) == 6
    with av.open(str(folder / "videos" / "overhead" / "b.mp4")) as container:
        frames = list(container.decode(video=0))
    assert [frame.time for frame in frames] == pytest.approx(np.arange(7) / 10.0)
    for i, frame in enumerate(frames):
        difference = frame.to_ndarray(format="rgb24").astype(int) - picture(i, "overhead")
        assert np.abs(difference).mean() < 5
