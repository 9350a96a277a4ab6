from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from bask_data.cli.app import app
from bask_data.dataset import Dataset
from bask_data.evaluation import evaluated_masks
from bask_data.evaluation.frames import Frames
from bask_data.evaluation.identity_names import identity_names
from bask_data.evaluation.tables import mask_lines
from bask_data.kinds import Identities, Truth, VisibleMasks
from bask_data.kinds.identities import IdentityRow, MemberRow, UnknownRow
from bask_data.kinds.truth import TruthMetadata
from tests.datasets import publish_artifact, publish_identities, publish_recording
from tests.scenes import intrinsics

SIZE = (40, 60)
POT, CUP = 1, 2
SCENES = ("a", "b", "c")


def picture(columns: dict[int, tuple[int, int]]) -> np.ndarray:
    """Rows 10 to 20 of each label, from one column to another."""
    image = np.zeros(SIZE, np.uint8)
    for label, (begin, end) in columns.items():
        image[10:20, begin:end] = label
    return image


def publish_masks(dataset: Dataset, scene: str, instance: np.ndarray) -> None:
    n = int(instance.max())

    def fill(out: Path) -> None:
        with VisibleMasks.writer(out, n) as writer:
            writer.camera("wrist", 1, *SIZE).append(instance, np.ones(n, np.float32))

    publish_artifact(dataset, VisibleMasks, scene, fill)


@pytest.fixture
def dataset(tmp_path: Path) -> Dataset:
    """Three scans of a pot and a cup with labels; in `b` the instances have the other order, and the pot is cut."""
    dataset = Dataset.create(tmp_path / "d")
    labels = picture({POT: (5, 25), CUP: (40, 50)})
    masks = {
        "a": picture({1: (5, 25), 2: (40, 50)}),
        "b": picture({2: (5, 15), 1: (40, 50)}),
        "c": picture({1: (5, 25), 2: (40, 48)}),
    }
    metadata = TruthMetadata(label_names={POT: "pot", CUP: "cup"})

    def fill(out: Path) -> None:
        with Truth.writer(out, metadata, np.zeros((1, 0, 4, 4))) as writer:
            writer.camera("wrist", 1, SIZE, 1e-4).append(labels, np.ones(SIZE, np.uint16), np.eye(4))

    for scene in SCENES:
        publish_recording(
            dataset,
            scene,
            rgb=[np.zeros((*SIZE, 3), np.uint8)],
            depth=[np.ones(SIZE, np.float32)],
            K=intrinsics(*SIZE),
            world_from_cameras=np.eye(4)[None],
        )
        publish_artifact(dataset, Truth, scene, fill)
        publish_masks(dataset, scene, masks[scene])
    return dataset


def test_masks_are_reported_by_name_over_all_scans(dataset: Dataset) -> None:
    before = evaluated_masks(dataset)
    assert set(before) == {"scenes", "all"} and "identity" not in before["scenes"]["a"]["objects"][0]
    publish_identities(dataset, {"kettle": [("a", 1), ("b", 2), ("c", 1)], "": [("a", 2), ("b", 1)]})
    found = evaluated_masks(dataset)
    assert found["all"] == before["all"]
    told = {
        (scene, body["names"][0]): body["identity"]
        for scene, score in found["scenes"].items()
        for body in score["objects"]
    }
    assert told == {
        **{(scene, "pot"): "kettle" for scene in SCENES},
        ("a", "cup"): "identity 2",
        ("b", "cup"): "identity 2",
        ("c", "cup"): None,
    }
    assert found["by_name"] == {
        "identity 2": {"n_scans": 2, "iou": 1.0, "worst": 1.0, "shows": {"cup": 2}},
        "kettle": {"n_scans": 3, "iou": pytest.approx(2.5 / 3), "worst": 0.5, "shows": {"pot": 3}},
    }
    assert found["outdated"] == []


def test_a_wrong_match_shows_as_two_objects_under_one_name(dataset: Dataset) -> None:
    publish_identities(dataset, {"kettle": [("a", 1), ("b", 1)]})
    found = evaluated_masks(dataset)
    assert found["by_name"]["kettle"]["shows"] == {"pot": 1, "cup": 1}
    assert "    kettle                           2 scans        IoU 1.000, worst 1.000; shows pot 1, cup 1" in [
        *mask_lines(found)
    ]


def test_names_of_masks_that_changed_are_not_used_and_that_is_said(dataset: Dataset) -> None:
    publish_identities(dataset, {"kettle": [("a", 1), ("b", 2)]})
    publish_masks(dataset, "b", picture({1: (5, 15), 2: (40, 50)}))
    assert identity_names(dataset) == {("a", 1): "kettle"}
    found = evaluated_masks(dataset)
    assert found["outdated"] == ["b"]
    assert {body["identity"] for body in found["scenes"]["b"]["objects"]} == {None}
    assert any("no names for b: the masks have changed" in line for line in mask_lines(found))


def test_the_command_prints_names_for_people_and_scripts(dataset: Dataset) -> None:
    publish_identities(dataset, {"kettle": [("a", 1), ("b", 2)]})
    shown = CliRunner().invoke(app, ["evaluate", "masks", str(dataset.root), "--json"])
    assert json.loads(shown.stdout)["by_name"]["kettle"]["n_scans"] == 2
    lines = CliRunner().invoke(app, ["evaluate", "masks", str(dataset.root)]).stdout.splitlines()
    assert sum("pot " in line and line.endswith("kettle") for line in lines) == 2


def test_descriptors_are_grouped_by_name_where_no_exact_truth_names_objects(dataset: Dataset) -> None:
    assert Frames(dataset, "b").objects == {POT: "pot", CUP: "cup"}
    for scene in SCENES:
        shutil.rmtree(dataset.path(Truth, scene))
    assert Frames(dataset, "b").objects == {1: "b 1", 2: "b 2"}
    publish_identities(dataset, {"kettle": [("a", 1), ("b", 2)]})
    assert Frames(dataset, "a").objects == {1: "kettle", 2: "a 2"}
    assert Frames(dataset, "b").objects == {1: "b 1", 2: "kettle"}


def test_identities_of_one_name_are_told_apart(dataset: Dataset) -> None:
    publish_identities(dataset, {"box": [("a", 1), ("b", 2)], "": [("a", 2), ("b", 1)]})
    assert identity_names(dataset)["a", 1] == "box"

    def fill(out: Path) -> None:
        rows = [
            IdentityRow(id=i, name="box", members=[MemberRow(scene="a", instance=i, confidence=1.0)]) for i in (1, 2)
        ]
        unknown = [
            UnknownRow(scene="b", instance=1, why="tie", name="box"),
            UnknownRow(scene="b", instance=2, why="tie", name="can"),
            UnknownRow(scene="c", instance=1, why="tie"),
        ]
        nothing = {name: [] for name in Identities.tables["pairs.parquet"].columns}
        Identities.write(out, identities=rows, unknown=unknown, pairs=nothing, picture=b"", warnings=[])

    publish_artifact(dataset, Identities, "", fill)
    assert Identities(dataset.path(Identities)).names_of_instances() == {
        ("a", 1): "box (identity 1)",
        ("a", 2): "box (identity 2)",
        ("b", 1): "box (b/1)",
        ("b", 2): "can",
    }
