from __future__ import annotations

import json
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import pytest

from bask_data.dataset import Dataset
from bask_data.engine import Position, RunRequest, Snapshot, plan, run, run_pipeline, state_of, status
from bask_data.errors import UsageError
from bask_data.kinds import Reconstruction
from tests.toy_stages import fuse, learn, pick

STAGES = (fuse, pick, learn)


def test_everything_is_made_in_order_with_its_position(dataset: Dataset) -> None:
    begun: list[Position] = []
    outcomes = list(run_pipeline(dataset, STAGES, begin=begun.append))
    assert [(outcome.label, outcome.status) for outcome in outcomes] == [
        ("fuse a", "made"),
        ("fuse b", "made"),
        ("pick a", "made"),
        ("pick b", "made"),
        ("learn", "made"),
    ]
    assert [outcome.position for outcome in outcomes] == begun
    assert begun[3] == Position("pick", "main", 2, 3, "b", 2, 2)
    assert [standing.state.status for standing in status(dataset, STAGES)] == ["up to date"] * 5


def test_on_an_executor_the_beginning_of_a_stage_is_reported(dataset: Dataset) -> None:
    begun: list[Position] = []
    with ThreadPoolExecutor(2) as pool:
        outcomes = list(run_pipeline(dataset, STAGES, executor=pool, begin=begun.append))
    assert [(place.stage, place.item) for place in begun] == [("fuse", ""), ("pick", ""), ("learn", "")]
    assert [outcome.position.item_number for outcome in outcomes if outcome.position] == [1, 2, 1, 2, 1]


def test_a_bad_parameter_of_a_late_stage_is_refused_before_anything_is_made(dataset: Dataset) -> None:
    with pytest.raises(UsageError, match="pick: n: expected"):
        run_pipeline(dataset, STAGES, RunRequest(given={"pick": {"n": 1}}))
    assert not (dataset.root / "reconstruction").exists()


def test_a_stage_on_request_is_made_when_named_and_then_kept_up_to_date(dataset: Dataset) -> None:
    stages = (fuse, replace(pick, on_request=True))
    assert [outcome.label for outcome in run_pipeline(dataset, stages)] == ["fuse a", "fuse b"]
    assert [standing.label for standing in status(dataset, stages)] == ["fuse a", "fuse b"]
    list(run_pipeline(dataset, stages, RunRequest(stages=("pick",), only=("b",))))
    changed = RunRequest(given={"fuse": {"voxel_size": 0.2}})
    assert [standing.label for standing in status(dataset, stages)] == ["fuse a", "fuse b", "pick b"]
    outcomes = list(run_pipeline(dataset, stages, changed))
    assert [(each.label, each.status) for each in outcomes] == [
        ("fuse a", "made"),
        ("fuse b", "made"),
        ("pick b", "made"),
    ]


def test_dry_run_names_the_inputs_made_before(dataset: Dataset) -> None:
    outcomes = list(run_pipeline(dataset, STAGES, dry_run=True))
    assert [outcome.status for outcome in outcomes] == ["would make"] * 5
    assert outcomes[2].why == "after reconstruction/a"
    assert outcomes[2].position == Position("pick", "main", 2, 3, "a", 1, 2)
    assert not (dataset.root / "reconstruction").exists()


def test_only_requested_scenes_and_stages_are_made(dataset: Dataset) -> None:
    outcomes = run_pipeline(dataset, STAGES, RunRequest(stages=("fuse", "pick"), only=("b",)))
    assert [outcome.label for outcome in outcomes] == ["fuse b", "pick b"]


@pytest.mark.parametrize(
    ("request_", "message"),
    [
        (RunRequest(stages=("fusing",)), "stages: expected some of fuse, pick, learn, got fusing"),
        (
            RunRequest(stages=("fuse",), variant="big"),
            "fuse: variant: expected no variant, got big.  fix: variants are made by learn.",
        ),
        (RunRequest(only=("c",)), "--only: expected one of a, b, got c"),
        (RunRequest(options={"voxel_size": 1}), "options: expected exactly one stage with options, got all"),
    ],
)
def test_unknown_names_in_a_request_are_refused(dataset: Dataset, request_: RunRequest, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        run_pipeline(dataset, STAGES, request_)


def test_a_dataset_without_recordings_is_refused(tmp_path: Path) -> None:
    empty = Dataset.create(tmp_path / "empty")
    with pytest.raises(UsageError, match="expected a recording, got none in the dataset"):
        run_pipeline(empty, STAGES)
    with pytest.raises(UsageError, match="expected a scene, got none in the dataset"):
        run_pipeline(empty, STAGES, RunRequest(stages=("fuse",)))


def test_status_says_what_is_missing_blocked_and_stale(dataset: Dataset) -> None:
    list(run(plan(dataset, fuse, only=["a"])))
    states = {
        standing.label: standing.state
        for standing in status(dataset, STAGES, RunRequest(given={"fuse@a": {"ignored": 1}}))
    }
    assert (states["fuse a"].status, states["fuse a"].why) == ("stale", "changed: ignored 0 -> 1")
    assert states["fuse b"].status == "missing"
    blocked = states["pick b"].blocked
    assert blocked is not None
    assert (blocked.kind, blocked.paths) == ("input missing", (dataset.path(Reconstruction, "b"),))


def test_snapshot_keeps_its_first_reading_and_makers_do_not_use_it(dataset: Dataset) -> None:
    seen = Snapshot()
    [task, _] = plan(dataset, fuse)
    assert state_of(task, seen).status == "missing"
    assert [outcome.status for outcome in run(plan(dataset, fuse))] == ["made", "made"]
    assert state_of(task, seen).status == "missing"
    assert state_of(task).status == "up to date"
    assert state_of(task, Snapshot()).status == "up to date"


def test_each_manifest_is_read_once_by_a_snapshot(dataset: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    from bask_data.engine import snapshot

    list(run_pipeline(dataset, STAGES))
    read, paths = snapshot.read_manifest, list[Path]()
    monkeypatch.setattr(snapshot, "read_manifest", lambda path: (paths.append(path), read(path))[1])
    assert {standing.state.status for standing in status(dataset, STAGES)} == {"up to date"}
    assert len(paths) == len(set(paths)) == 7


def test_damaged_manifest_blocks_its_artifact_and_what_reads_it(dataset: Dataset) -> None:
    list(run_pipeline(dataset, STAGES))
    (dataset.path(Reconstruction, "a") / "artifact.json").write_text(json.dumps({"kind": "reconstruction"}))
    states = {standing.label: standing.state for standing in status(dataset, STAGES)}
    assert (states["fuse a"].status, states["fuse a"].why) == ("stale", "its manifest is missing or damaged")
    blocked = states["pick a"].blocked
    assert blocked is not None
    assert blocked.kind == "input broken"
    assert states["pick b"].status == "up to date"


def test_a_dry_run_predicts_that_artifacts_below_a_stale_one_may_be_remade(dataset: Dataset) -> None:
    list(run_pipeline(dataset, STAGES))
    request = RunRequest(given={"fuse@a": {"voxel_size": 0.2}})
    outcomes = {outcome.label: outcome for outcome in run_pipeline(dataset, STAGES, request, dry_run=True)}
    assert [outcome.status for outcome in outcomes.values()] == [
        "would make",
        "up to date",
        "may make",
        "up to date",
        "may make",
    ]
    assert outcomes["pick a"].why == "if this changes: reconstruction/a"
    assert outcomes["learn"].why == "if this changes: objects/a"


@pytest.mark.parametrize(
    ("position", "label"),
    [
        (Position("masks", "main", 3, 7, "a", 1, 4), "stage 3 of 7: masks a (1 of 4)"),
        (Position("encode", "big", 1, 1, "lift", 1, 1), "encode big lift"),
        (Position("masks", "main", 1, 1, "", 1, 4), "masks (4 items)"),
        (Position("train", "main", 5, 7, "", 1, 1), "stage 5 of 7: train"),
    ],
)
def test_a_position_reads_as_stage_variant_and_item(position: Position, label: str) -> None:
    assert position.label == label
