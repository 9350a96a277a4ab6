from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path

import av
import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest

from bask_data.dataset import Dataset
from bask_data.errors import BadData, UsageError
from bask_data.export import ExportSettings, export, lerobot_files
from bask_data.export.episodes import Episodes
from bask_data.export.lerobot_stats import QUANTILES, image_stats, merged_stats, vector_stats
from bask_data.formats import FORMATS
from bask_data.formats.options.lerobot import LerobotOptions
from bask_data.kinds import Demonstration
from bask_data.sources.ingest import ingest
from tests.export.encoded import Demo, picture, seen_demo, state

ORDER = "acb"
KEY = "observation.images.wrist"


@pytest.fixture(scope="module")
def folder(encoded, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("lerobot") / "out"
    export(encoded[0], out, "lerobot", ExportSettings(videos=True, validation=("b",)))
    return out


def meta(folder: Path, name: str = "info") -> dict:
    return json.loads((folder / "meta" / f"{name}.json").read_text())


def episodes(folder: Path) -> list[dict]:
    return pq.read_table(folder / "meta/episodes/chunk-000/file-000.parquet").to_pylist()


def frames_table(folder: Path) -> dict[str, np.ndarray]:
    table = pq.read_table(folder / "data/chunk-000/file-000.parquet")
    return {name: np.array(table[name].to_pylist()) for name in table.column_names}


def test_every_value_of_every_frame_is_read_back(encoded, folder: Path) -> None:
    values, demos = frames_table(folder), [encoded[1][name] for name in ORDER]
    lengths = [len(demo.mean) for demo in demos]
    np.testing.assert_allclose(values["observation.state"], np.concatenate([state(d) for d in demos]), rtol=1e-6)
    np.testing.assert_array_equal(values["observation.environment_state"], values["observation.state"][:, :8])
    np.testing.assert_allclose(values["action"], np.concatenate([d.robot.action for d in demos]), rtol=1e-6)
    observed = [d.observed["wrist"] | d.observed["overhead"] for d in demos]
    np.testing.assert_array_equal(values["keypoints.observed"], np.concatenate(observed))
    assert values["keypoints.localised"].all()
    np.testing.assert_array_equal(values["recorded_time"], np.concatenate([d.time for d in demos]))
    np.testing.assert_array_equal(values["index"], np.arange(28))
    np.testing.assert_array_equal(values["episode_index"], np.repeat([0, 1, 2], lengths))
    np.testing.assert_array_equal(values["frame_index"], np.concatenate([np.arange(n) for n in lengths]))
    np.testing.assert_allclose(values["timestamp"], values["frame_index"] / 10, rtol=1e-6)
    np.testing.assert_array_equal(values["task_index"], np.repeat([0, 0, 1], lengths))


def test_the_dataset_is_described(folder: Path) -> None:
    info = meta(folder)
    assert (info["codebase_version"], info["fps"]) == ("v3.0", 10)
    assert (info["total_episodes"], info["total_frames"], info["total_tasks"]) == (3, 28, 2)
    assert info["splits"] == {"train": "0:2", "validation": "2:3"}
    features = info["features"]
    assert (features["observation.state"]["shape"], features["action"]["shape"]) == ([18], [4])
    assert features["observation.state"]["names"][:3] == ["handle.x", "handle.y", "handle.z"]
    assert features["action"]["names"] == ["dx", "dy", "dz", "width"]
    assert (features[KEY]["dtype"], features[KEY]["shape"]) == ("video", [16, 24, 3])
    assert features["timestamp"] == {"dtype": "float32", "shape": [1], "names": None}
    # LeRobot takes every feature named `observation...` as a policy's input.
    seen = {name for name in features if name.startswith("observation.") and "images" not in name}
    assert seen == {"observation.state", "observation.environment_state"}


def test_episodes_state_their_positions_in_files(folder: Path) -> None:
    rows = episodes(folder)
    assert [row["length"] for row in rows] == [12, 9, 7]
    assert [(row["dataset_from_index"], row["dataset_to_index"]) for row in rows] == [(0, 12), (12, 21), (21, 28)]
    assert [row["tasks"] for row in rows] == [["put the lid on"], ["put the lid on"], ["stir"]]
    times = [(row[f"videos/{KEY}/from_timestamp"], row[f"videos/{KEY}/to_timestamp"]) for row in rows]
    np.testing.assert_allclose(times, [(0, 1.2), (1.2, 2.1), (2.1, 2.8)])


def test_one_video_holds_all_episodes_one_after_the_other(folder: Path) -> None:
    with av.open(str(folder / "videos" / KEY / "chunk-000" / "file-000.mp4")) as container:
        frames = list(container.decode(video=0))
    assert [frame.time for frame in frames] == pytest.approx(np.arange(28) / 10)
    numbers = [i for n in (12, 9, 7) for i in range(n)]
    for frame, i in zip(frames, numbers, strict=True):
        difference = frame.to_ndarray(format="rgb24").astype(int) - picture(i)
        assert np.abs(difference).mean() < 5
    assert [frame.key_frame for frame in frames] == [True, False] * 14


def test_files_that_reach_their_size_end_after_the_episode(
    encoded, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lerobot_files, "DATA_BYTES", 1)
    monkeypatch.setattr(lerobot_files, "VIDEO_BYTES", 1)
    monkeypatch.setattr(lerobot_files, "FILES_PER_CHUNK", 2)
    export(encoded[0], tmp_path / "out", "lerobot", ExportSettings(videos=True))
    places = [(0, 0), (0, 1), (1, 0)]
    rows = episodes(tmp_path / "out")
    assert [(row["data/chunk_index"], row["data/file_index"]) for row in rows] == places
    assert [(row[f"videos/{KEY}/chunk_index"], row[f"videos/{KEY}/file_index"]) for row in rows] == places
    assert [row[f"videos/{KEY}/from_timestamp"] for row in rows] == [0.0, 0.0, 0.0]
    for (chunk, file), n in zip(places, (12, 7, 9), strict=True):
        name = f"chunk-{chunk:03d}/file-{file:03d}"
        assert pq.read_metadata(tmp_path / "out" / "data" / f"{name}.parquet").num_rows == n
        with av.open(str(tmp_path / "out" / "videos" / KEY / f"{name}.mp4")) as container:
            assert len(list(container.decode(video=0))) == n


def test_statistics_of_values_agree_with_numpy() -> None:
    values = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)
    found = vector_stats(values)
    np.testing.assert_allclose(found["mean"], values.mean(axis=0), rtol=1e-5)
    np.testing.assert_allclose(found["std"], values.std(axis=0), rtol=1e-5)
    assert (found["min"], found["max"]) == (values.min(axis=0).tolist(), values.max(axis=0).tolist())
    np.testing.assert_allclose(found["q90"], np.quantile(values.astype(float), 0.9, axis=0))
    assert found["count"] == [50]
    assert vector_stats(np.arange(4))["mean"] == [1.5]


def test_statistics_of_images_agree_with_numpy() -> None:
    images = np.random.default_rng(0).integers(3, 250, (4, 8, 9, 3), dtype=np.uint8)
    counts = np.array([np.bincount(images[..., i].ravel(), minlength=256) for i in range(3)])
    found, shares = image_stats(counts, 4), images.reshape(-1, 3) / 255
    assert np.shape(found["mean"]) == (3, 1, 1) and found["count"] == [4]
    np.testing.assert_allclose(np.ravel(found["mean"]), shares.mean(axis=0))
    np.testing.assert_allclose(np.ravel(found["std"]), shares.std(axis=0))
    np.testing.assert_allclose(np.ravel(found["min"]), shares.min(axis=0))
    np.testing.assert_allclose(np.ravel(found["max"]), shares.max(axis=0))
    for share in QUANTILES:
        expected = np.quantile(shares, share, axis=0, method="inverted_cdf")
        np.testing.assert_allclose(np.ravel(found[f"q{round(100 * share):02d}"]), expected)


def test_statistics_of_parts_are_merged_to_those_of_the_whole() -> None:
    parts = [np.random.default_rng(i).normal(i, 1 + i, (20 * (i + 1), 2)) for i in range(3)]
    merged, whole = merged_stats([vector_stats(part) for part in parts]), vector_stats(np.concatenate(parts))
    for name in ("mean", "std", "min", "max", "count"):
        np.testing.assert_allclose(merged[name], whole[name])
    # As in LeRobot: quantiles of the parts, averaged by their lengths.
    averaged = np.average([np.quantile(part, 0.5, axis=0) for part in parts], axis=0, weights=[20, 40, 60])
    np.testing.assert_allclose(merged["q50"], averaged)


def test_statistics_cover_a_policys_inputs_and_outputs(folder: Path) -> None:
    stats, rows = meta(folder, "stats"), episodes(folder)
    values = frames_table(folder)
    for name in ("observation.state", "action"):
        np.testing.assert_allclose(stats[name]["mean"], values[name].mean(axis=0), rtol=1e-5, atol=1e-7)
        np.testing.assert_allclose(stats[name]["std"], values[name].std(axis=0), rtol=1e-5, atol=1e-7)
    assert np.shape(stats[KEY]["std"]) == (3, 1, 1)
    assert rows[1]["stats/action/max"] == values["action"][12:21].max(axis=0).tolist()
    assert rows[1][f"stats/{KEY}/count"] == [9]


def with_rate(root: Path, **rates: float) -> Dataset:
    dataset = Dataset.create(root)
    for name, fps in rates.items():
        demo = Demo(0, 5)
        demo.time = np.arange(5) / fps
        demo.publish(dataset, name)
    return dataset


def test_a_rate_close_to_an_integer_is_rounded(tmp_path: Path) -> None:
    done = export(with_rate(tmp_path / "d", a=29.94, b=30.02), tmp_path / "out", "lerobot", ExportSettings())
    assert (meta(tmp_path / "out")["fps"], done.notes) == (30, [])


def test_a_rate_that_is_not_an_integer_is_kept_and_noted(tmp_path: Path) -> None:
    done = export(with_rate(tmp_path / "d", a=12.5), tmp_path / "out", "lerobot", ExportSettings(videos=True))
    assert meta(tmp_path / "out")["fps"] == 12.5
    assert done.notes == ["the rate of 12.500 frames per second is not an integer; some LeRobot tools need one."]


def test_demonstrations_of_different_rates_are_refused(tmp_path: Path) -> None:
    with pytest.raises(BadData, match="time: expected about 10 frames per second, as a has, got 15"):
        export(with_rate(tmp_path / "d", a=10, b=15), tmp_path / "out", "lerobot", ExportSettings())


def test_an_export_without_videos_and_actions_has_none(tmp_path: Path) -> None:
    dataset, demo = Dataset.create(tmp_path / "d"), Demo()
    demo.robot = None
    demo.publish(dataset, "a")
    export(dataset, tmp_path / "out", "lerobot", ExportSettings())
    info = meta(tmp_path / "out")
    assert info["video_path"] is None and info["features"]["observation.state"]["shape"] == [8]
    assert "action" not in info["features"] and not (tmp_path / "out" / "videos").exists()


def image(value: dict, flags: int = cv2.IMREAD_UNCHANGED) -> np.ndarray:
    return cv2.imdecode(np.frombuffer(value["bytes"], np.uint8), flags)


def test_cameras_are_written_without_loss(tmp_path: Path) -> None:
    dataset = Dataset.create(tmp_path / "d")
    demo = seen_demo()
    demo.publish(dataset, "a")
    done = export(dataset, tmp_path / "out", "lerobot", ExportSettings(cameras=True))
    assert done.notes == []
    table = pq.read_table(tmp_path / "out/data/chunk-000/file-000.parquet").to_pylist()
    for i, row in enumerate(table):
        np.testing.assert_array_equal(image(row[KEY])[..., ::-1], picture(i))
        np.testing.assert_array_equal(image(row[f"{KEY}_depth"]), demo.depth[i])
        np.testing.assert_array_equal(row["camera.wrist.world_from_camera"], demo.world_from_cameras[i].ravel())
        np.testing.assert_array_equal(row["camera.wrist.intrinsics"], demo.K[i].ravel())
        assert (row["camera.wrist.depth_scale"], row["camera.wrist.time"]) == (0.001, demo.time[i])
        np.testing.assert_array_equal(row["recorded_world_from_gripper"], demo.robot.world_from_gripper[i].ravel())
        np.testing.assert_array_equal(row["recorded_action"], demo.robot.action[i])
        assert row["recorded_gripper_width"] == demo.robot.gripper_width[i]
    features = meta(tmp_path / "out")["features"]
    assert (features[KEY]["dtype"], features[KEY]["shape"]) == ("image", [16, 24, 3])
    assert features[f"{KEY}_depth"]["info"] == {"is_depth_map": True, "depth_unit": "mm"}
    assert meta(tmp_path / "out")["video_path"] is None
    stats = meta(tmp_path / "out", "stats")[f"{KEY}_depth"]
    assert np.ravel(stats["max"]) == demo.depth.max() and np.shape(stats["max"]) == (1, 1, 1)
    np.testing.assert_allclose(np.ravel(stats["mean"]), demo.depth.mean())


@pytest.mark.parametrize("depth_scale", [0.001, 0.0002])
def test_an_export_with_cameras_comes_back_through_ingest_with_the_same_numbers(
    tmp_path: Path, depth_scale: float
) -> None:
    dataset = Dataset.create(tmp_path / "d")
    demos = {name: seen_demo(i, 5 + i, depth_scale) for i, name in enumerate("ab")}
    for name, demo in demos.items():
        demo.publish(dataset, name, task="pour")
    export(dataset, tmp_path / "out", "lerobot", ExportSettings(cameras=True))
    ingested = next(format for format in FORMATS if format.name == "lerobot")
    for i, demo in enumerate(demos.values()):
        options = LerobotOptions(episode=str(i))
        ingest(
            tmp_path / "again", f"x{i}", format=ingested, source=tmp_path / "out", options=options, kind="demonstration"
        )
        again = Demonstration(tmp_path / f"again/demonstration/x{i}")
        [camera] = again.cameras
        assert (camera.name, camera.n_frames, camera.depth_scale) == ("wrist", 5 + i, depth_scale)
        for k in range(camera.n_frames):
            np.testing.assert_array_equal(camera.rgb(k), picture(k))
            np.testing.assert_array_equal(camera.depth_raw(k), demo.depth[k])
        np.testing.assert_array_equal(camera.Ks, demo.K)
        np.testing.assert_array_equal(camera.time, demo.time)
        np.testing.assert_allclose(camera.world_from_cameras, demo.world_from_cameras, atol=1e-15)
        np.testing.assert_allclose(again.robot.world_from_gripper, demo.robot.world_from_gripper, atol=1e-15)
        np.testing.assert_array_equal(again.robot.gripper_width, demo.robot.gripper_width)
        np.testing.assert_array_equal(again.robot.action, demo.robot.action)
        assert again.metadata.action_names == list(demo.robot.action_names)
        demo.publish_track(Dataset(tmp_path / "again"), f"x{i}")
    assert {entry.task for entry in Episodes(Dataset(tmp_path / "again"), ExportSettings()).entries} == {"pour"}


def test_depth_in_other_units_than_lerobots_is_noted(tmp_path: Path) -> None:
    dataset = Dataset.create(tmp_path / "d")
    for name, scale in (("a", 0.001), ("b", 0.0002)):
        seen_demo(depth_scale=scale).publish(dataset, name)
    done = export(dataset, tmp_path / "out", "lerobot", ExportSettings(videos=True, cameras=True))
    [note] = done.notes
    assert note == f"{KEY}_depth is in steps of 0.2 mm, but LeRobot takes it for millimetres; `ingest` does not."
    features = meta(tmp_path / "out")["features"]
    assert features[KEY]["dtype"] == "video" and features[f"{KEY}_depth"]["info"] == {"is_depth_map": True}


def test_cameras_are_refused_by_formats_that_ingest_does_not_read(encoded, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="--cameras: expected the format .*lerobot.*, got parquet.  fix: pass"):
        export(encoded[0], tmp_path / "out", "parquet", ExportSettings(cameras=True))


READER = """
import json, sys
import numpy as np
import torch
from lerobot.configs.types import FeatureType
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.datasets.utils import dataset_to_policy_features

root, to = sys.argv[1:]
rate = json.load(open(root + "/meta/info.json"))["fps"]
dataset = LeRobotDataset("local/x", root=root, video_backend="pyav")
items = [dataset[i] for i in range(len(dataset))]
keys = [key for key in items[0] if key != "task"]
found = {key.replace(".", "__"): np.stack([item[key].numpy() for item in items]) for key in keys}
found["tasks"] = np.array([item["task"] for item in items])
chunked = LeRobotDataset(
    "local/x", root=root, video_backend="pyav", episodes=[1], delta_timestamps={"action": [i / rate for i in range(3)]}
)
found["chunk"] = chunked[8]["action"].numpy()
found["padding"] = chunked[8]["action_is_pad"].numpy()

from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.modeling_act import ACTPolicy

features = dataset_to_policy_features(dataset.meta.features)
inputs = {k: f for k, f in features.items() if f.type in (FeatureType.STATE, FeatureType.ENV)}
outputs = {k: f for k, f in features.items() if f.type is FeatureType.ACTION}
small = {"dim_model": 32, "n_heads": 2, "dim_feedforward": 32, "n_encoder_layers": 1, "chunk_size": 3}
config = ACTConfig(input_features=inputs, output_features=outputs, n_action_steps=3, device="cpu", **small)
batch = torch.utils.data.default_collate([chunked[i] for i in range(4)])
loss, _ = ACTPolicy(config).forward(batch)
found["loss"] = loss.detach().numpy()
np.savez(to, **found)
"""


def loaded_by_lerobot(folder: Path, tmp_path: Path) -> dict[str, np.ndarray]:
    """All values of an export, read by the lerobot package in its own Python."""
    command = [os.environ["BASK_DATA_LEROBOT"], "-c", READER, str(folder), str(tmp_path / "read.npz")]
    environment = {**os.environ, "HF_HUB_OFFLINE": "1", "HF_HOME": str(tmp_path / "home"), "CUDA_VISIBLE_DEVICES": ""}
    ended = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=500)
    assert ended.returncode == 0, ended.stderr[-3000:]
    with np.load(tmp_path / "read.npz") as read:
        return dict(read)


@pytest.mark.skipif("BASK_DATA_LEROBOT" not in os.environ, reason="BASK_DATA_LEROBOT names no Python with lerobot")
def test_lerobot_loads_every_value_and_a_policy_accepts_it(encoded, folder: Path, tmp_path: Path) -> None:
    read = loaded_by_lerobot(folder, tmp_path)
    demos = [encoded[1][name] for name in ORDER]
    np.testing.assert_allclose(read["observation__state"], np.concatenate([state(d) for d in demos]), rtol=1e-6)
    np.testing.assert_allclose(read["action"], np.concatenate([d.robot.action for d in demos]), rtol=1e-6)
    assert read["tasks"].tolist() == ["put the lid on"] * 21 + ["stir"] * 7
    images = np.concatenate([[picture(i) for i in range(len(d.mean))] for d in demos])
    difference = 255 * read[KEY.replace(".", "__")].transpose(0, 2, 3, 1) - images
    assert np.abs(difference).mean(axis=(1, 2, 3)).max() < 5
    np.testing.assert_allclose(read["chunk"], demos[1].robot.action[[8, 8, 8]], rtol=1e-6)
    assert read["padding"].tolist() == [False, True, True]
    assert np.isfinite(read["loss"])


@pytest.mark.skipif("BASK_DATA_LEROBOT" not in os.environ, reason="BASK_DATA_LEROBOT names no Python with lerobot")
def test_lerobot_loads_cameras_too(tmp_path: Path) -> None:
    dataset = Dataset.create(tmp_path / "d")
    demos = [seen_demo(0, 12), seen_demo(1, 9)]
    for name, demo in zip("ab", demos, strict=True):
        demo.publish(dataset, name)
    export(dataset, tmp_path / "out", "lerobot", ExportSettings(cameras=True))
    read = loaded_by_lerobot(tmp_path / "out", tmp_path)
    key = KEY.replace(".", "__")
    images = np.concatenate([[picture(i) for i in range(len(demo.mean))] for demo in demos])
    np.testing.assert_allclose(255 * read[key].transpose(0, 2, 3, 1), images, atol=1e-3)
    np.testing.assert_array_equal(read[f"{key}_depth"][:, 0], np.concatenate([demo.depth for demo in demos]))
    poses = np.concatenate([demo.world_from_cameras for demo in demos]).reshape(-1, 16)
    np.testing.assert_allclose(read["camera__wrist__world_from_camera"], poses, rtol=1e-6, atol=1e-6)
