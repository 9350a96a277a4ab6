from __future__ import annotations

import json
import shutil
import socket
import sys
import weakref
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner, Result

from bask_data.artifact import Artifact, digest_of, list_files, seal
from bask_data.cli.app import app
from bask_data.dataset import Dataset
from bask_data.engine import key_parts, plan
from bask_data.errors import BadData, BaskError, MissingDependency, UsageError, WouldOverwrite
from bask_data.export import FORMATS, ExportSettings, export
from bask_data.export.episodes import Episodes, held
from bask_data.kinds import Camera, DescriptorNet, KeypointTrack, ReferenceKeypoints, Robot
from bask_data.stages.encode import encode
from tests.datasets import publish_artifact
from tests.export.encoded import KEYPOINTS, Demo, state

NAMES = {"parquet": "out", "lerobot": "out", "robomimic": "out.hdf5", "diffusion-policy": "out.zarr"}
EACH_FORMAT = pytest.mark.parametrize("format", [format.name for format in FORMATS])


def single(root: Path, demo: Demo) -> Dataset:
    """A dataset with one demonstration."""
    dataset = Dataset.create(root)
    demo.publish(dataset, "a")
    return dataset


def keypoints(dataset: Dataset, **choice: object) -> dict[str, np.ndarray]:
    """Positions (t, k, 3) as exported."""
    found = {}
    for episode in Episodes(dataset, ExportSettings(**choice)):
        found[episode.entry.name] = episode.values["keypoints"].reshape(episode.entry.n_frames, -1, 3)
    return found


def bytes_below(path: Path) -> dict[str, bytes]:
    files = [("", path)] if path.is_file() else list_files(path)
    return {name: file.read_bytes() for name, file in files}


def test_a_policys_observation_is_keypoints_their_spread_and_the_gripper(encoded) -> None:
    dataset, demos = encoded
    episodes = Episodes(dataset, ExportSettings())
    names = [name for column in episodes.state for name in column.values]
    assert names[:8] == [
        *("handle.x", "handle.y", "handle.z", "lid.x", "lid.y", "lid.z"),
        *("handle.spread", "lid.spread"),
    ]
    assert names[8:11] == ["gripper.x", "gripper.y", "gripper.z"]
    assert (len(names), names[-1]) == (18, "gripper.width")
    for episode in episodes:
        np.testing.assert_allclose(episode.state, state(demos[episode.entry.name]), rtol=1e-6)


def test_third_axis_of_the_gripper_is_the_cross_product_of_the_exported_two(encoded) -> None:
    dataset, demos = encoded
    for episode in Episodes(dataset, ExportSettings()):
        x_axis, y_axis = np.split(episode.values["gripper_rotation"], 2, axis=1)
        expected = demos[episode.entry.name].robot.world_from_gripper[:, :3, 2]
        np.testing.assert_allclose(np.cross(x_axis, y_axis), expected, atol=1e-6)


def test_a_keypoint_is_observed_where_any_camera_observes_it(encoded) -> None:
    dataset, demos = encoded
    for episode in Episodes(dataset, ExportSettings()):
        demo = demos[episode.entry.name]
        np.testing.assert_array_equal(episode.values["observed"], demo.observed["wrist"] | demo.observed["overhead"])


def test_a_keypoint_that_is_not_localised_keeps_its_position_and_is_marked(tmp_path: Path) -> None:
    demo = Demo(0, 6)
    demo.mean[:2, 0] = np.nan
    demo.mean[4, 1] = np.nan
    demo.covariance[4, 1] = np.nan
    dataset = single(tmp_path / "d", demo)
    episodes = Episodes(dataset, ExportSettings())
    [episode] = episodes
    positions = episode.values["keypoints"].reshape(6, 2, 3)
    np.testing.assert_array_equal(positions[:2, 0], demo.mean[[2, 2], 0])
    np.testing.assert_array_equal(positions[4, 1], demo.mean[3, 1])
    np.testing.assert_array_equal(positions[2:, 0], demo.mean[2:, 0])
    assert np.argwhere(~episode.values["localised"]).tolist() == [[0, 0], [1, 0], [4, 1]]
    assert not episode.values["observed"][~episode.values["localised"]].any()
    assert episode.values["spread"][4, 1] == episode.values["spread"][3, 1]
    assert episodes.notes == ["a: 3 positions are from other frames, as the keypoint was not localised."]


@given(st.lists(st.booleans(), min_size=1).filter(any))
def test_unknown_values_are_the_last_known_or_else_the_first_known_ones(known: list[bool]) -> None:
    values = np.arange(float(len(known)))
    for i, value in enumerate(held(values[:, None], np.array(known)[:, None])[:, 0]):
        before = [j for j in range(i + 1) if known[j]]
        assert value == (before[-1] if before else known.index(True))


def test_noise_has_the_requested_size_is_seeded_and_independent_between_demonstrations(tmp_path: Path) -> None:
    dataset = Dataset.create(tmp_path / "d")
    demos = {name: Demo(0, 400) for name in "ab"}
    for name, demo in demos.items():
        demo.publish(dataset, name)
    noisy = keypoints(dataset, noise=0.02)
    error = {name: noisy[name] - demos[name].mean for name in "ab"}
    # 2400 samples: the standard deviation is known to 1.5 %, the mean to 0.4 mm.
    assert np.std(error["a"]) == pytest.approx(0.02, rel=0.06)
    assert abs(np.mean(error["a"])) < 0.0016
    assert abs(np.corrcoef(error["a"][:-1].ravel(), error["a"][1:].ravel())[0, 1]) < 0.08
    assert abs(np.corrcoef(error["a"].ravel(), error["b"].ravel())[0, 1]) < 0.08
    np.testing.assert_array_equal(keypoints(dataset, noise=0.02, only=("b",))["b"], noisy["b"])
    assert np.abs(keypoints(dataset, noise=0.02, seed=1)["a"] - noisy["a"]).max() > 0.01
    np.testing.assert_array_equal(keypoints(dataset)["a"], demos["a"].mean)


def test_demonstrations_for_training_come_first_whatever_their_order(encoded) -> None:
    dataset, _ = encoded
    episodes = Episodes(dataset, ExportSettings(validation=("a",), test=("b",)))
    assert [(entry.name, entry.split) for entry in episodes.entries] == [
        *(("c", "train"), ("a", "validation"), ("b", "test"))
    ]


def test_the_task_is_the_option_or_the_sources_or_the_datasets_name(encoded, tmp_path: Path) -> None:
    dataset, _ = encoded
    assert [entry.task for entry in Episodes(dataset, ExportSettings()).entries] == [
        "put the lid on",
        "stir",
        "put the lid on",
    ]
    assert {entry.task for entry in Episodes(dataset, ExportSettings(task="cook")).entries} == {"cook"}
    assert Episodes(single(tmp_path / "garden", Demo()), ExportSettings()).entries[0].task == "garden"


@EACH_FORMAT
def test_the_same_demonstrations_give_the_same_bytes(encoded, tmp_path: Path, format: str) -> None:
    choice = ExportSettings(videos=True, noise=0.02, validation=("b",))
    outs = [tmp_path / str(i) / NAMES[format] for i in range(2)]
    for out in outs:
        export(encoded[0], out, format, choice)
    assert bytes_below(outs[0]) == bytes_below(outs[1])


@EACH_FORMAT
def test_every_format_includes_a_description_of_its_values(encoded, tmp_path: Path, format: str) -> None:
    out = tmp_path / NAMES[format]
    export(encoded[0], out, format, ExportSettings(noise=0.02, seed=7, test=("c",)))
    if format == "robomimic":
        with h5py.File(out) as file:
            described = json.loads(file["bask"].asstr()[()])
    elif format == "diffusion-policy":
        described = json.loads((out / ".zattrs").read_text())["bask"]
    else:
        described = json.loads((out / "bask.json").read_text())
    assert (described["format"], described["dataset"], described["licence"]) == (format, "kitchen", "CC0")
    assert (described["noise"], described["seed"], described["keypoints"]) == (0.02, 7, KEYPOINTS)
    assert described["splits"] == {"train": ["a", "b"], "validation": [], "test": ["c"]}
    episodes = described["episodes"]
    assert [(entry["name"], entry["n_frames"]) for entry in episodes] == [("a", 12), ("b", 7), ("c", 9)]
    assert [entry["filter"] for entry in episodes] == ["particle"] * 3
    assert episodes[0]["fps"] == pytest.approx(10.0)
    assert {column["name"]: column["units"] for column in described["columns"]}["keypoints"] == "metre"
    assert "world" in described["conventions"]


@EACH_FORMAT
def test_an_existing_export_is_replaced_only_with_force(encoded, tmp_path: Path, format: str) -> None:
    dataset, out = encoded[0], tmp_path / NAMES[format]
    export(dataset, out, format, ExportSettings())
    before = bytes_below(out)
    with pytest.raises(
        WouldOverwrite, match=r"expected a new path, got one that exists.  fix: --force replaces an export\."
    ):
        export(dataset, out, format, ExportSettings(only=("a",)))
    assert bytes_below(out) == before
    export(dataset, out, format, ExportSettings(only=("a",)), force=True)
    assert bytes_below(out) != before
    assert [file.name for file in tmp_path.iterdir()] == [NAMES[format]]


@EACH_FORMAT
def test_nothing_but_an_export_is_replaced(encoded, tmp_path: Path, format: str) -> None:
    out = tmp_path / NAMES[format]
    out.mkdir()
    (out / "letters.txt").write_text("dear")
    with pytest.raises(WouldOverwrite, match=r"--force: expected .*, got something else.  fix: choose another OUT\."):
        export(encoded[0], out, format, ExportSettings(), force=True)
    assert (out / "letters.txt").read_text() == "dear"


def hdf5(file: Path, **texts: str) -> None:
    with h5py.File(file, "w") as written:
        written["data/demo_0/actions"] = np.ones((3, 4))
        for name, text in texts.items():
            written[name] = text


@pytest.mark.parametrize(
    "write",
    [
        lambda file: file.write_text("dear"),
        lambda file: hdf5(file),
        lambda file: hdf5(file, bask="a mask, misspelt"),
        lambda file: hdf5(file, bask="5"),
        lambda file: hdf5(file, bask='{"format": "of mine"}'),
    ],
    ids=["text", "hdf5", "another text", "a number", "another format"],
)
def test_no_file_but_an_exported_one_is_replaced(encoded, tmp_path: Path, write: Callable[[Path], object]) -> None:
    out = tmp_path / "mine.h5"
    write(out)
    before = out.read_bytes()
    with pytest.raises(WouldOverwrite, match="--force: expected a robomimic file of bask-data, got something else"):
        export(encoded[0], out, "robomimic", ExportSettings(), force=True)
    assert out.read_bytes() == before
    assert cli("export", "robomimic", encoded[0].root, out, "--force").exit_code == 3


def test_a_file_that_only_links_to_an_export_is_not_replaced(encoded, tmp_path: Path) -> None:
    export(encoded[0], tmp_path / "ours.h5", "robomimic", ExportSettings())
    with h5py.File(tmp_path / "mine.h5", "w") as written:
        written["bask"] = h5py.ExternalLink("ours.h5", "bask")
    with pytest.raises(WouldOverwrite, match="got something else"):
        export(encoded[0], tmp_path / "mine.h5", "robomimic", ExportSettings(), force=True)


@pytest.mark.parametrize("name", [".zattrs", "bask.json"])
@pytest.mark.parametrize("text", ["5", '["bask"]', '{"bask": 5}', '{"bask": {}}', "{", ""])
def test_a_folder_with_another_description_is_not_replaced(encoded, tmp_path: Path, name: str, text: str) -> None:
    out = tmp_path / "own"
    out.mkdir()
    (out / name).write_text(text)
    with pytest.raises(WouldOverwrite, match="--force: expected an exported folder, got something else"):
        export(encoded[0], out, "diffusion-policy", ExportSettings(), force=True)
    assert (out / name).read_text() == text


def test_a_path_inside_the_dataset_or_above_it_is_refused(encoded, tmp_path: Path) -> None:
    root = encoded[0].root
    (tmp_path / "way").symlink_to(root)
    before = [name for name, _ in list_files(root)]
    for out in (root, root / "keypoints" / "out", root.parent, tmp_path / "way" / "out", root / ".." / root.name / "x"):
        with pytest.raises(UsageError, match="OUT: expected a path outside the dataset, got one that overlaps"):
            export(encoded[0], out, "parquet", ExportSettings(), force=True)
    assert cli("export", "parquet", root, root / "out").exit_code == 2
    assert [name for name, _ in list_files(root)] == before
    export(encoded[0], root.with_name(f"{root.name}-out"), "parquet", ExportSettings(only=("b",)))


@EACH_FORMAT
def test_an_interrupted_export_leaves_the_previous_one(
    encoded, tmp_path: Path, format: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / NAMES[format]
    export(encoded[0], out, format, ExportSettings(only=("a",)))
    before = bytes_below(out)

    def read(self: Episodes, entry: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(Episodes, "_read", read)
    with pytest.raises(KeyboardInterrupt):
        export(encoded[0], out, format, ExportSettings(), force=True)
    assert bytes_below(out) == before
    assert [file.name for file in tmp_path.iterdir()] == [NAMES[format]]


def test_a_full_disk_is_reported(encoded, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(pq, "write_table", refuse)
    with pytest.raises(BaskError, match="expected a writable location, got .*No space left on device"):
        export(encoded[0], tmp_path / "out", "parquet", ExportSettings())
    assert list(tmp_path.iterdir()) == []


def test_a_robomimic_file_has_a_suffix_of_hdf5(encoded, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"OUT: expected a name that ends in .hdf5 or .h5, got out\.zip"):
        export(encoded[0], tmp_path / "out.zip", "robomimic", ExportSettings())


def test_without_h5py_the_command_that_installs_it_is_named(
    encoded, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(MissingDependency, match=r"expected h5py, got none.  fix: pip install 'bask-data\[export\]'"):
        export(encoded[0], tmp_path / "out.hdf5", "robomimic", ExportSettings())


@pytest.mark.parametrize(
    ("choice", "complaint"),
    [
        ({"only": ("x",)}, "--only: expected one of a, b, c, got x"),
        ({"validation": ("x",)}, "--validation: expected one of a, b, c, got x"),
        ({"test": ("x", "a")}, "--test: expected one of a, b, c, got x"),
        ({"test": ("a", "b"), "validation": ("b",)}, "--test: expected no demonstrations of --validation, got b"),
        ({"noise": -0.1}, "--noise: expected 0 metres or more, got -0.1"),
        ({"noise": float("nan")}, "--noise: expected 0 metres or more, got nan"),
    ],
)
def test_invalid_options_are_refused(encoded, choice: dict[str, object], complaint: str) -> None:
    with pytest.raises(UsageError, match=complaint):
        Episodes(encoded[0], ExportSettings(**choice))


def test_a_dataset_without_demonstrations_has_nothing_to_export(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="expected a demonstration, got none in the dataset"):
        Episodes(Dataset.create(tmp_path / "d"), ExportSettings())


def test_a_demonstration_without_keypoints_names_the_command_that_makes_them(encoded) -> None:
    with pytest.raises(
        BadData, match=r"expected keypoints of the demonstration, got none.  fix: bask-data encode .* -"
    ):
        Episodes(encoded[0], ExportSettings(variant="sharp"))


def test_a_track_with_another_number_of_frames_is_refused(tmp_path: Path) -> None:
    demo = Demo(0, 6)
    dataset = single(tmp_path / "d", demo)
    Demo(0, 5).publish_track(dataset, "a")
    with pytest.raises(BadData, match="mean: expected 6 frames, as camera wrist has, got 5"):
        Episodes(dataset, ExportSettings())


def test_a_track_with_a_missing_file_is_refused(tmp_path: Path) -> None:
    dataset = single(tmp_path / "d", Demo())
    next(path for path in dataset.path(KeypointTrack, "a").glob("mean/c/**/*") if path.is_file()).unlink()
    with pytest.raises(BadData, match="expected the file, got none"):
        Episodes(dataset, ExportSettings())


def test_a_keypoint_that_is_never_localised_is_refused(tmp_path: Path) -> None:
    demo = Demo(0, 6)
    demo.mean[:, 1] = np.nan
    with pytest.raises(BadData, match="lid: expected a position in at least one frame, got none in any"):
        list(Episodes(single(tmp_path / "d", demo), ExportSettings()))


def test_an_action_that_is_not_finite_is_refused(tmp_path: Path) -> None:
    demo = Demo(0, 6)
    demo.robot.action[3, 2] = np.nan
    with pytest.raises(BadData, match="action: expected finite numbers, got NaN or infinity.  fix: ingest"):
        list(Episodes(single(tmp_path / "d", demo), ExportSettings()))


def test_a_robot_with_another_number_of_frames_is_refused(tmp_path: Path) -> None:
    demo, short = Demo(0, 6), Demo(0, 5).robot
    demo.robot = Robot(short.world_from_gripper, short.gripper_width, short.action, short.action_names)
    with pytest.raises(BadData, match="gripper_position: expected 6 frames, as the cameras have, got 5"):
        list(Episodes(single(tmp_path / "d", demo), ExportSettings()))


def test_times_that_do_not_increase_are_refused(tmp_path: Path) -> None:
    demo = Demo(0, 6)
    demo.time[3] = demo.time[2]
    with pytest.raises(
        BadData, match="time: expected times that increase with the frames, got 5.2 s after 5.2 s at frame 3"
    ):
        Episodes(single(tmp_path / "d", demo), ExportSettings())


def test_a_single_frame_has_no_rate(tmp_path: Path) -> None:
    with pytest.raises(BadData, match="time: expected two frames or more, got 1"):
        Episodes(single(tmp_path / "d", Demo(0, 1)), ExportSettings())


def test_a_gap_is_noted(tmp_path: Path) -> None:
    demo = Demo(0, 8)
    demo.time[4:] += 2.0
    done = export(single(tmp_path / "d", demo), tmp_path / "out", "parquet", ExportSettings())
    [note] = done.notes
    assert note.startswith("a: 1 intervals between frames exceed 1.5 times the median of 0.1 s")


def test_held_out_demonstrations_that_are_not_exported_are_noted(encoded, tmp_path: Path) -> None:
    choice = ExportSettings(only=("a", "b"), validation=("b", "c"), test=("a",))
    assert export(encoded[0], tmp_path / "out", "parquet", choice).notes == [
        "--validation c: left out, because --only does not name it."
    ]


def test_different_filters_are_noted_and_recorded_with_each_demonstration(tmp_path: Path) -> None:
    dataset = Dataset.create(tmp_path / "d")
    for i, name in enumerate("abc"):
        demo = Demo(i)
        demo.filter = "discrete" if name == "b" else "particle"
        demo.publish(dataset, name)
    done = export(dataset, tmp_path / "out", "parquet", ExportSettings())
    assert done.notes == ["the keypoints are of different filters: particle: a, c; discrete: b."]
    described = json.loads((tmp_path / "out" / "bask.json").read_text())
    assert [entry["filter"] for entry in described["episodes"]] == ["particle", "discrete", "particle"]
    assert pq.read_table(tmp_path / "out" / "episodes.parquet")["filter"].to_pylist() == [
        *("particle", "discrete", "particle")
    ]
    assert export(dataset, tmp_path / "alike", "parquet", ExportSettings(only=("a", "c"))).notes == []


def put_input(dataset: Dataset, kind: type[Artifact], content: str) -> None:
    """Publish a network or a reference whose content is not read."""
    publish_artifact(dataset, kind, "", lambda out: (out / "content").write_text(content))


def encode_as_now(dataset: Dataset, item: str, demo: Demo) -> None:
    """Publish a track whose manifest says that it is up to date."""
    [task] = plan(dataset, encode, only=(item,))
    demo.publish_track(dataset, item)
    parts, path = key_parts(task), dataset.path(KeypointTrack, item)
    seal(
        path,
        artifact=KeypointTrack,
        stage="encode",
        stage_version=encode.version,
        params=parts["params"],
        inputs=parts["inputs"],
        key=digest_of(parts),
    )


@pytest.fixture
def tracked(tmp_path: Path) -> tuple[Dataset, dict[str, Demo]]:
    """Two demonstrations whose keypoints are up to date."""
    dataset, demos = Dataset.create(tmp_path / "d"), {"a": Demo(0), "b": Demo(1)}
    for kind in (DescriptorNet, ReferenceKeypoints):
        put_input(dataset, kind, "first")
    for name, demo in demos.items():
        demo.publish(dataset, name)
        encode_as_now(dataset, name, demo)
    return dataset, demos


def test_stale_keypoints_are_noted(tracked, tmp_path: Path) -> None:
    dataset, demos = tracked

    def notes(out: str) -> list[str]:
        return export(dataset, tmp_path / out, "parquet", ExportSettings()).notes

    assert notes("new") == []
    put_input(dataset, DescriptorNet, "second")
    changed = "the keypoints are not up to date (changed: descriptor/main); see `bask-data status`."
    assert notes("network") == [f"a, b: {changed}"]
    encode_as_now(dataset, "a", demos["a"])
    assert notes("one") == [f"b: {changed}"]
    encode_as_now(dataset, "b", demos["b"])
    (dataset.root / "params.yaml").write_text("encode@b:\n  filter: discrete\n")
    assert notes("parameters") == [
        "b: the keypoints are not up to date (changed: filter particle -> discrete); see `bask-data status`."
    ]
    (dataset.root / "params.yaml").write_text("- encode\n")
    [note] = notes("broken")
    assert (
        note.startswith("cannot check whether the keypoints are up to date: ")
        and "expected a section per stage, got list" in note
    )
    (dataset.root / "params.yaml").unlink()
    shutil.rmtree(dataset.path(ReferenceKeypoints))
    [note] = notes("gone")
    assert note.startswith("a, b: the keypoints are not up to date (reference/main is missing)")


def test_keypoints_of_different_references_are_refused(tracked) -> None:
    dataset, demos = tracked
    put_input(dataset, ReferenceKeypoints, "second")
    assert len(Episodes(dataset, ExportSettings())) == 2
    encode_as_now(dataset, "b", demos["b"])
    complaint = r"reference: expected [0-9a-f]{12}, as for a, got [0-9a-f]{12}\.  fix: bask-data encode"
    with pytest.raises(BadData, match=complaint):
        Episodes(dataset, ExportSettings())
    assert len(Episodes(dataset, ExportSettings(only=("b",)))) == 1
    encode_as_now(dataset, "a", demos["a"])
    assert len(Episodes(dataset, ExportSettings())) == 2


def differing(root: Path, change: str) -> Dataset:
    dataset, demo = Dataset.create(root), Demo(1)
    Demo(0).publish(dataset, "a")
    robot = demo.robot
    if change == "names":
        demo.names = ["handle", "knob"]
    elif change == "actions":
        demo.robot = Robot(robot.world_from_gripper, robot.gripper_width, robot.action, ("dx", "dy", "dz", "force"))
    elif change == "no robot":
        demo.robot = None
    elif change == "cameras":
        demo = Demo(1, cameras=("overhead",))
    else:
        demo.size = (8, 8)
    demo.publish(dataset, "b")
    return dataset


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ("names", "keypoints: expected handle.x, .*lid.z, as a has, got handle.x, .*knob.z"),
        ("actions", "action: expected dx, dy, dz, width, as a has, got dx, dy, dz, force"),
        ("no robot", "gripper_position: expected gripper.x, gripper.y, gripper.z, as a has, got none"),
        ("cameras", "cameras: expected wrist 24x16, as a has, got overhead 24x16"),
        ("sizes", "cameras: expected wrist 24x16, as a has, got wrist 8x8"),
    ],
)
def test_inconsistent_demonstrations_are_refused(tmp_path: Path, change: str, complaint: str) -> None:
    dataset = differing(tmp_path / "d", change)
    with pytest.raises(BadData, match=complaint):
        Episodes(dataset, ExportSettings(videos=True))
    assert len(Episodes(dataset, ExportSettings(only=("b",)))) == 1


def test_a_robot_only_in_later_demonstrations_is_refused(tmp_path: Path) -> None:
    dataset = differing(tmp_path / "d", "no robot")
    with pytest.raises(BadData, match="gripper_position: expected none, as b has none, got some"):
        Episodes(dataset, ExportSettings(validation=("a",)))


@pytest.mark.parametrize("format", ["robomimic", "diffusion-policy"])
def test_without_actions_there_is_no_policy_to_learn(tmp_path: Path, format: str) -> None:
    demo = Demo()
    demo.robot = None
    with pytest.raises(
        BadData,
        match="robot/action: expected the robot's action, got none.  fix: record the robot's action, or export to p",
    ):
        export(single(tmp_path / "d", demo), tmp_path / NAMES[format], format, ExportSettings())


@EACH_FORMAT
def test_few_images_are_in_memory_at_a_time(tmp_path: Path, format: str, monkeypatch: pytest.MonkeyPatch) -> None:
    read, alive, most = Camera.rgb, [], 0

    def counted(self: Camera, i_frame: int) -> np.ndarray:
        nonlocal alive, most
        image = read(self, i_frame).copy()
        alive = [ref for ref in [*alive, weakref.ref(image)] if ref() is not None]
        most = max(most, len(alive))
        return image

    dataset = single(tmp_path / "d", Demo(0, 90))
    monkeypatch.setattr(Camera, "rgb", counted)
    export(dataset, tmp_path / NAMES[format], format, ExportSettings(videos=True))
    assert 1 <= most <= 34


def test_one_demonstration_is_in_memory_at_a_time(encoded) -> None:
    alive: list[weakref.ref] = []
    for episode in Episodes(encoded[0], ExportSettings()):
        alive.append(weakref.ref(episode.values["keypoints"]))
        assert [ref() is not None for ref in alive] == [False] * (len(alive) - 1) + [True]
        del episode
    assert len(alive) == 3


def test_scratch_of_a_killed_export_is_removed(encoded, tmp_path: Path) -> None:
    left = tmp_path / ".scratch" / f"export~{socket.gethostname()}~999999999~0"
    left.mkdir(parents=True)
    export(encoded[0], tmp_path / "out", "parquet", ExportSettings())
    assert [file.name for file in tmp_path.iterdir()] == ["out"]


def test_an_unwritable_location_is_reported(encoded, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(BaskError, match="expected a writable location, got .*exists"):
        export(encoded[0], tmp_path / "file" / "out", "parquet", ExportSettings())


def cli(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def test_the_command_writes_reports_and_refuses_an_existing_path(encoded, tmp_path: Path) -> None:
    dataset, _ = encoded
    out = tmp_path / "kitchen.hdf5"
    done = cli("export", "robomimic", dataset.root, out, "--noise", "0.02", "--validation", "b", "--json")
    assert done.exit_code == 0, done.stderr
    summary = json.loads(done.stdout)
    assert summary["command"] == "export"
    assert summary["splits"] == {"train": ["a", "c"], "validation": ["b"], "test": []}
    assert summary["n_bytes"] == out.stat().st_size
    assert summary["columns"]["keypoints"] == 6
    assert "made " in done.stderr and "2 for train, 1 for validation; 28 frames" in done.stderr
    assert "next: python -m robomimic.scripts.get_dataset_info" in done.stderr
    assert cli("export", "robomimic", dataset.root, out).exit_code == 3
    assert cli("export", "robomimic", dataset.root, out, "--force").exit_code == 0
    assert cli("export", "robomimic", dataset.root, tmp_path / "x").exit_code == 2
    assert cli("export", "parquet", dataset.root, tmp_path / "x", "--variant", "sharp").exit_code == 4
    assert cli("export", "rosbag", dataset.root, tmp_path / "x").exit_code == 2


def test_the_command_knows_every_format() -> None:
    shown = cli("export", "--help").stdout
    assert all(name in shown for name in [format.name for format in FORMATS])
