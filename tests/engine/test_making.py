from __future__ import annotations

import json
import pickle
import shutil
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import pytest
from filelock import FileLock

from bask_data.artifact import read_manifest
from bask_data.core.tsdf import Mesh
from bask_data.dataset import Dataset, Splits, Variant
from bask_data.engine import Outcome, Stage, State, follow, in_order, is_follower, make, plan, predicted, run, state_of
from bask_data.errors import UsageError
from bask_data.kinds import DescriptorNet, Reconstruction, ReferenceKeypoints
from tests.datasets import add_scan
from tests.toy_stages import fuse, label, learn, pick


def statuses(dataset: Dataset, stage: Stage, **options: object) -> list[str]:
    return [outcome.status for outcome in run(plan(dataset, stage, **options))]  # type: ignore[arg-type]


def one(dataset: Dataset, stage: Stage, **options: object) -> Outcome:
    [task] = plan(dataset, stage, **options)  # type: ignore[arg-type]
    return make(task)


def test_signature_defines_what_a_stage_reads_and_makes() -> None:
    assert [(given.artifact.kind, given.gather) for given in learn.inputs] == [("scan", True), ("objects", True)]
    assert learn.wants_splits
    assert learn.resumable
    assert pick.makes.kind == "objects"
    assert [(given.artifact.kind, given.gather) for given in pick.inputs] == [("reconstruction", False)]


def test_stages_are_ordered_by_what_they_read() -> None:
    assert [stage.name for stage in in_order([learn, pick, fuse])] == ["fuse", "pick", "learn"]


def test_second_run_makes_nothing(dataset: Dataset) -> None:
    assert statuses(dataset, fuse) == ["made", "made"]
    inode = dataset.path(Reconstruction, "a").stat().st_ino
    assert statuses(dataset, fuse) == ["up to date", "up to date"]
    assert dataset.path(Reconstruction, "a").stat().st_ino == inode


def test_changed_parameter_remakes_and_says_why(dataset: Dataset) -> None:
    statuses(dataset, fuse)
    tasks = plan(dataset, fuse, config={"fuse@b": {"voxel_size": 0.2}})
    assert [state_of(task).status for task in tasks] == ["up to date", "stale"]
    assert state_of(tasks[1]).why == "changed: voxel_size 0.1 -> 0.2"


def test_remade_input_with_the_same_bytes_leaves_everything_below_up_to_date(dataset: Dataset) -> None:
    statuses(dataset, fuse)
    statuses(dataset, pick)
    assert statuses(dataset, fuse, options={"ignored": 1}) == ["made", "made"]
    assert statuses(dataset, pick) == ["up to date", "up to date"]
    assert statuses(dataset, fuse, options={"voxel_size": 0.3}) == ["made", "made"]
    assert statuses(dataset, pick) == ["made", "made"]


def test_new_stage_version_makes_the_old_artifact_stale(dataset: Dataset) -> None:
    statuses(dataset, fuse)
    [task, _] = plan(dataset, fuse)
    manifest = read_manifest(task.target)
    older = json.loads(manifest.model_dump_json()) | {"stage_version": 0, "key": "0" * 64}
    (task.target / "artifact.json").write_text(json.dumps(older))
    assert state_of(task).why == "made by version 0 of the stage, this is 1"


def test_content_of_a_file_that_a_parameter_names_is_part_of_the_key(dataset: Dataset, tmp_path: Path) -> None:
    file = tmp_path / "weights"
    file.write_text("one")
    assert statuses(dataset, fuse, options={"file": str(file)}) == ["made", "made"]
    assert statuses(dataset, fuse, options={"file": str(file)}) == ["up to date", "up to date"]
    file.write_text("two")
    [task, _] = plan(dataset, fuse, options={"file": str(file)})
    assert state_of(task) == State("stale", "changed: files")
    file.unlink()
    outcome = make(task)
    assert outcome.status == "failed"
    assert "fuse: file: expected a file, got" in outcome.why


def test_missing_input_blocks_and_names_it(dataset: Dataset) -> None:
    outcomes = list(run(plan(dataset, pick)))
    assert [(outcome.status, outcome.why) for outcome in outcomes] == [
        ("blocked", "reconstruction/a is missing"),
        ("blocked", "reconstruction/b is missing"),
    ]
    blocked = outcomes[0].blocked
    assert blocked is not None
    assert blocked.kind == "input missing"
    assert blocked.fix == "make it first, or use `bask-data run` without --only."
    assert blocked.paths == (dataset.path(Reconstruction, "a"),)


def test_failure_of_one_item_leaves_the_others_and_the_old_artifact(dataset: Dataset) -> None:
    statuses(dataset, fuse)
    before = read_manifest(dataset.path(Reconstruction, "a")).digest
    config = {"fuse@a": {"fail": "this"}, "fuse": {"voxel_size": 0.5}}
    outcomes = list(run(plan(dataset, fuse, config=config)))
    assert [outcome.status for outcome in outcomes] == ["failed", "made"]
    assert outcomes[0].why == "frame: expected something else, got this."
    assert read_manifest(dataset.path(Reconstruction, "a")).digest == before
    assert not [path for path in (dataset.root / ".scratch").iterdir() if path.is_dir()]


def test_dry_run_makes_nothing(dataset: Dataset) -> None:
    outcomes = list(predicted(plan(dataset, fuse), set()))
    assert [outcome.status for outcome in outcomes] == ["would make", "would make"]
    assert not (dataset.root / "reconstruction").exists()


def test_gathering_stage_reads_every_item_and_the_splits(dataset: Dataset) -> None:
    statuses(dataset, fuse)
    statuses(dataset, pick)
    assert one(dataset, learn).status == "made"
    net = DescriptorNet(dataset.path(DescriptorNet))
    assert net.metadata.metrics["n_scans"] == 2
    dataset.set_splits(Splits(train=("a",), validation=("b",)))
    [task] = plan(Dataset(dataset.root), learn)
    assert state_of(task).why == "changed: splits"
    assert make(task).status == "made"
    assert DescriptorNet(dataset.path(DescriptorNet)).metadata.metrics["n_train"] == 1


def test_adding_a_scene_leaves_the_others_and_remakes_what_gathers(dataset: Dataset) -> None:
    for stage in (fuse, pick, learn):
        statuses(dataset, stage)
    add_scan(dataset, "c")
    assert statuses(dataset, fuse) == ["up to date", "up to date", "made"]
    assert statuses(dataset, pick) == ["up to date", "up to date", "made"]
    assert one(dataset, learn).status == "made"


def test_interrupted_resumable_stage_continues_from_its_scratch(dataset: Dataset) -> None:
    statuses(dataset, fuse)
    statuses(dataset, pick)
    (dataset.root / "interrupt").touch()
    with pytest.raises(KeyboardInterrupt):
        one(dataset, learn)
    (dataset.root / "interrupt").unlink()
    assert one(dataset, learn).status == "made"
    assert DescriptorNet(dataset.path(DescriptorNet)).metadata.metrics["resumed_at"] == 2
    assert not list((dataset.root / ".scratch").glob("resume~*/"))


def test_variants_exist_side_by_side(dataset: Dataset) -> None:
    for stage in (fuse, pick):
        statuses(dataset, stage)
    assert one(dataset, learn, variant="small").status == "made"
    dataset.add_variant(DescriptorNet, "small", Variant())
    assert (dataset.root / "descriptor" / "small" / "artifact.json").exists()
    assert not (dataset.root / "descriptor" / "main").exists()
    assert list(Dataset(dataset.root).variants(DescriptorNet)) == ["main", "small"]


def test_tasks_run_in_other_processes(dataset: Dataset) -> None:
    [task, _] = plan(dataset, fuse)
    assert pickle.loads(pickle.dumps(task)).stage is fuse  # noqa: S301  # What a process pool does.
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        outcomes = list(run(plan(dataset, fuse), executor=pool))
    assert {(outcome.item, outcome.status) for outcome in outcomes} == {("a", "made"), ("b", "made")}


def test_errors_survive_pickling_between_processes(dataset: Dataset) -> None:
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        [outcome, *_] = run(plan(dataset, fuse, options={"fail": "this"}, only=["a"]), executor=pool)
    assert outcome.error is not None
    assert outcome.error.exit_code == 4
    assert str(outcome.error) == "frame: expected something else, got this."


def test_unknown_item_is_refused_with_the_choices(dataset: Dataset) -> None:
    with pytest.raises(UsageError, match="--only: expected one of a, b, got c"):
        plan(dataset, fuse, only=["c"])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"voxel_size": -1}, "fuse: voxel_size: expected greater than 0, got -1"),
        ({"voxel": 1}, "fuse: voxel: .* fix: one of voxel_size, fail, ignored, file."),
    ],
)
def test_invalid_parameters_are_refused(dataset: Dataset, options: dict[str, object], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        plan(dataset, fuse, options=options)


def test_manifest_depends_only_on_content(dataset: Dataset, tmp_path: Path) -> None:
    statuses(dataset, fuse)
    copy = Dataset(
        shutil.copytree(dataset.root, tmp_path / "elsewhere", ignore=shutil.ignore_patterns("reconstruction"))
    )
    statuses(copy, fuse)
    for item in ("a", "b"):
        manifests = [
            (root / "reconstruction" / item / "artifact.json").read_bytes() for root in (dataset.root, copy.root)
        ]
        assert manifests[0] == manifests[1]


def test_provenance_is_stored_outside_the_artifact(dataset: Dataset) -> None:
    statuses(dataset, fuse)
    record = json.loads((dataset.root / "provenance" / "reconstruction" / "a.json").read_text())
    assert record["key"] == read_manifest(dataset.path(Reconstruction, "a")).key
    assert {"user", "host", "time", "seconds", "process_peak_bytes", "bask_data"} <= record.keys()


def test_logs_are_stored_outside_the_artifact_by_kind_and_variant(dataset: Dataset) -> None:
    for made in (fuse, pick):
        statuses(dataset, made)
    assert one(dataset, learn, variant="small").status == "made"
    assert [file.name for file in (dataset.root / "runs" / "descriptor" / "small").iterdir()] == ["process0"]


def test_first_of_several_processes_publishes_and_the_others_take_part(
    dataset: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    for made in (fuse, pick):
        statuses(dataset, made)
    assert not is_follower()
    for name, value in (("TORCHELASTIC_RUN_ID", "none"), ("WORLD_SIZE", "2"), ("RANK", "1")):
        monkeypatch.setenv(name, value)
    assert is_follower()
    [task] = plan(dataset, learn)
    follow(task, force=False)
    assert not task.target.exists()
    monkeypatch.setenv("RANK", "0")
    assert not is_follower()
    assert make(task).status == "made"
    logs = dataset.root / "runs" / "descriptor" / "main"
    # Both were given the same folder, or the others could not go on from what the first saved.
    assert (logs / "process0").read_text() == (logs / "process1").read_text()
    (logs / "process1").unlink()
    monkeypatch.setenv("RANK", "1")
    follow(task, force=False)
    assert not (logs / "process1").exists(), "there is nothing left to do"
    follow(task, force=True)
    assert (logs / "process1").exists()


def test_artifacts_open_with_plain_zarr(dataset: Dataset) -> None:
    import zarr

    statuses(dataset, fuse)
    group = zarr.open_group(str(dataset.root), mode="r")
    depth = group["scan/a/wrist/depth"]
    assert depth.shape == (2, 4, 6)
    assert depth.attrs["scale_m"] == 0.0001
    assert group["reconstruction/b"].attrs["bask"]["kind"] == "reconstruction"


def test_unexpected_exception_fails_only_its_item_and_is_reported(
    dataset: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    write = Reconstruction.write

    def full(out: Path, mesh: Mesh, **known: object) -> None:
        if len(mesh.vertices) == 6:
            raise OSError("No space left on device")
        write(out, mesh, **known)  # type: ignore[arg-type]

    monkeypatch.delenv("BASK_DEBUG", raising=False)
    monkeypatch.setattr(Reconstruction, "write", staticmethod(full))
    failed, made = run(plan(dataset, fuse))
    assert (failed.status, made.status) == ("failed", "made")
    assert f"{dataset.root}/reconstruction/a: OSError: No space left on device" in failed.why


def test_section_for_a_name_that_does_not_exist_is_refused(dataset: Dataset) -> None:
    with pytest.raises(UsageError, match="fuse@c: expected fuse@ and one of a, b, main, got c"):
        plan(dataset, fuse, config={"fuse@c": {"voxel_size": 1.0}})


def test_waiting_for_another_process_ends_with_its_artifact(dataset: Dataset) -> None:
    for stage in (fuse, pick):
        statuses(dataset, stage)
    [task] = plan(dataset, learn)
    folder = dataset.root / ".scratch"
    folder.mkdir(exist_ok=True)
    with ThreadPoolExecutor(1) as pool:
        with FileLock(folder / "resume~descriptor~main~~.lock"):
            waiting = pool.submit(make, task)
            # The other process: a copy of the dataset, in which the artifact is made and put in place.
            other = Dataset(shutil.copytree(dataset.root, dataset.root.with_name("other")))
            assert one(other, learn).status == "made"
            other.path(DescriptorNet).parent.mkdir(exist_ok=True)
            shutil.copytree(other.path(DescriptorNet), dataset.path(DescriptorNet))
            inode = dataset.path(DescriptorNet).stat().st_ino
        assert waiting.result().status == "made"
    assert dataset.path(DescriptorNet).stat().st_ino == inode


def test_inputs_not_needed_need_not_exist_and_are_not_in_the_key(dataset: Dataset) -> None:
    chosen = {"scans": ("b", "z"), "described": False}
    assert statuses(dataset, label) == ["blocked"]
    assert statuses(dataset, label, options=chosen) == ["made"]
    reference = ReferenceKeypoints(dataset.path(ReferenceKeypoints))
    assert (reference.names, reference.descriptors.tolist()) == (["b"], [[0.0]])
    assert list(reference.manifest.inputs) == ["scan/b"]
    add_scan(dataset, "a", level=7)
    assert statuses(dataset, label, options=chosen) == ["up to date"]
    add_scan(dataset, "b", level=7)
    assert statuses(dataset, label, options=chosen) == ["made"]


def test_dataset_without_items_blocks_unless_none_is_needed(tmp_path: Path) -> None:
    empty = Dataset.create(tmp_path / "empty")
    [task] = plan(empty, label, options={"described": False})
    state = state_of(task)
    assert (state.status, state.why) == ("blocked", "the dataset has no scenes")
    assert state.blocked is not None
    assert (state.blocked.kind, state.blocked.paths) == ("no items", ())
    assert state.blocked.fix == "bask-data ingest FORMAT SOURCE ROOT --scene NAME --as scan"
    assert statuses(empty, label, options={"scans": (), "described": False}) == ["made"]
