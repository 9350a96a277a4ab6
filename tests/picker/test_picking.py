from __future__ import annotations

import json
import re
import shutil
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

import bask_data.picker
from bask_data.artifact import SCRATCH
from bask_data.cli.app import app
from bask_data.config import load_config
from bask_data.dataset import Dataset, Variant
from bask_data.engine import RunRequest, plan, state_of, status
from bask_data.errors import BadData, UsageError
from bask_data.kinds import DescriptorNet, ReferenceKeypoints, VisibleMasks
from bask_data.picker import Picking, pick_keypoints
from bask_data.picker.desk import Desk
from bask_data.picker.requests import EditRequest, EmptyRequest, FramePixel
from bask_data.pipeline import STAGES
from bask_data.progress import listen
from bask_data.stages.reference import reference
from tests.datasets import copied
from tests.picker.pickable import frame
from tests.picker.serving import Served
from tests.stages.test_reference import without_objects

pytest.importorskip("uvicorn")
pytest.importorskip("starlette")


class Page(Served):
    """The page of `reference --pick`, served in this process as by the command."""

    def __init__(self, dataset: Dataset, variant: str = "main", **options: object) -> None:
        parameters = dataset.root / "params.yaml"
        inputs = {} if variant == "main" else {"descriptor": "main"}

        def planned(values: dict):
            config = load_config(parameters if parameters.exists() else None, [], STAGES)
            requested = {**options, **values}
            [task] = plan(dataset, reference, config=config, options=requested, variant=variant, variant_inputs=inputs)
            return task

        self.notes: list[str] = []
        picking = Picking(dataset, planned, parameters, "bask-data encode", inputs)
        self.outcomes: list = []
        self.run(lambda: self.outcomes.extend(pick_keypoints(picking, say=self.notes.append, opened=self.open)))

    def __enter__(self) -> Page:
        return self

    def __exit__(self, *_: object) -> None:
        self.end()


@pytest.fixture
def pickable_copy(pickable, tmp_path) -> Dataset:
    return copied(pickable, tmp_path / "d")


def click(page: Page, recording: str = "a", u: float = 40.0, v: float = 50.0, **more: object) -> dict:
    return page.answer("edit", do="add", at={"frame": [recording, "wrist", 1], "u": u, "v": v}, **more)


def test_saved_keypoints_are_made_by_the_stage_and_are_up_to_date(pickable_copy) -> None:
    with Page(pickable_copy, "hand") as page:
        click(page, name="rim")
        click(page, "lift", 60.5)
        found = page.answer("save")
    # An untrained network has hardly any point that is not ambiguous.
    assert re.fullmatch(r"2 keypoints saved as reference/hand( \(ambiguous: .*\))?", found["summary"])
    assert found["next"] == "bask-data encode"
    assert [outcome.status for outcome in page.outcomes] == ["made"]
    kept = ReferenceKeypoints(pickable_copy.path(ReferenceKeypoints, variant="hand"))
    assert [(pick.name, pick.recording, pick.u) for pick in kept.picks] == [
        ("rim", "a", 40.0),
        ("point_1", "lift", 60.5),
    ]
    assert kept.manifest.params["picks"] == ["a:wrist:1:40:50:rim", "lift:wrist:1:60.5:50:point_1"]
    assert Dataset(pickable_copy.root).variants(ReferenceKeypoints)["hand"] == Variant(inputs={"descriptor": "main"})
    assert yaml.safe_load((pickable_copy.root / "params.yaml").read_text()) == {
        "reference@hand": {"auto": False, "picks": kept.manifest.params["picks"]}
    }
    # With the parameters that `status` and `run` use.
    config = load_config(pickable_copy.root / "params.yaml", [], STAGES)
    [task] = plan(Dataset(pickable_copy.root), reference, config=config, variant="hand")
    assert state_of(task).status == "up to date"
    assert not list((pickable_copy.root / SCRATCH).glob("picks*.json"))


def test_the_next_draft_begins_with_the_saved_keypoints(pickable_copy) -> None:
    with Page(pickable_copy) as page:
        click(page, name="rim")
        page.answer("save")
    with Page(pickable_copy) as page:
        found = page.answer("start")
        assert [mark["name"] for mark in found["marks"]] == ["rim"]
        assert page.notes == []
        click(page)
        page.answer("save")
    assert ReferenceKeypoints(pickable_copy.path(ReferenceKeypoints)).names == ["rim", "point_1"]


def test_unsaved_keypoints_survive_the_end_of_the_command(pickable_copy) -> None:
    with Page(pickable_copy) as page:
        click(page)
        click(page, "b")
    assert page.outcomes == []
    with Page(pickable_copy) as page:
        assert page.notes == ["restored 2 unsaved keypoints"]
        assert [mark["recording"] for mark in page.answer("edit", do="undo")["marks"]] == ["a"]
    assert not pickable_copy.path(ReferenceKeypoints).exists()


def test_auto_begins_the_draft_with_proposals(pickable_copy) -> None:
    without_objects(pickable_copy, "a")
    with Page(pickable_copy, auto=True, n=3) as page:
        found = page.answer("start")
        assert [(mark["recording"], mark["name"]) for mark in found["marks"]] == [
            ("b", "object_1_0"),
            ("b", "object_2_0"),
            ("b", "object_3_0"),
        ]
        assert page.answer("edit", do="undo")["marks"] == []
        status, text = page.ask("propose", scene="lift", n=2)
        assert (status, "propose: scene: expected a scan with masks of its objects, got lift" in text.decode()) == (
            400,
            True,
        )
        page.answer("propose", scene="b", n=2)
        page.answer("save")
    kept = ReferenceKeypoints(pickable_copy.path(ReferenceKeypoints))
    assert [pick.instance for pick in kept.picks] == [1, 2]
    assert kept.manifest.params["auto"] is False
    assert np.isfinite([pick.point_world for pick in kept.picks]).all()


@pytest.mark.parametrize(
    ("job", "label", "n_done"), [("propose", "choosing keypoints", 0), ("save", "describing keypoints", 1)]
)
def test_proposing_and_saving_report_their_progress(pickable_copy, job: str, label: str, n_done: int) -> None:
    reached, looked_at = threading.Event(), threading.Event()

    def held(at: str, done: int, total: int | None) -> None:
        if at == label and done >= 2 and not reached.is_set():
            reached.set()
            assert looked_at.wait(60)

    with Page(pickable_copy) as page, ThreadPoolExecutor() as executor:
        for u in (40.0, 50.0, 60.0):
            click(page, u=u)
        listen(held)
        try:
            working = executor.submit(page.ask, job, **({"scene": "b", "n": 3} if job == "propose" else {}))
            assert reached.wait(60)
            state = page.answer("progress")["job"]
            assert (state["name"], state["label"], state["done"]) == (job, label, n_done)
            assert state["can_cancel"] == (job == "propose")
            page.answer("cancel")
        finally:
            listen(None)
            looked_at.set()
        status, text = working.result(60)
    assert status == 200
    assert json.loads(text).get("is_cancelled", False) == (job == "propose")
    assert pickable_copy.path(ReferenceKeypoints).exists() == (job == "save")


def test_two_pages_at_once_are_refused(pickable_copy) -> None:
    with (
        Page(pickable_copy),
        pytest.raises(UsageError, match="--pick: main: expected no other page for this variant, got one that is open"),
    ):
        pick_keypoints(
            Picking(
                pickable_copy,
                lambda values: plan(pickable_copy, reference, options=values)[0],
                pickable_copy.root / "p",
                "",
            ),
            say=print,
            opened=print,
        )


def test_an_input_missing_for_saving_is_reported_on_the_page(pickable_copy) -> None:
    shutil.rmtree(pickable_copy.path(VisibleMasks, "a"))
    with Page(pickable_copy) as page:
        click(page)
        status, text = page.ask("save")
        assert (status, "expected to be made, got masks/a is missing" in json.loads(text)["error"]) == (400, True)
        assert len(page.answer("start")["marks"]) == 1
    assert not (pickable_copy.root / "params.yaml").exists()


def test_parameters_that_cannot_be_written_leave_the_artifact_as_it_was(pickable_copy) -> None:
    with Page(pickable_copy, "hand") as page:
        click(page, name="rim")
        page.answer("save")
        (pickable_copy.root / "params.yaml").unlink()
        (pickable_copy.root / "params.yaml").mkdir()
        click(page, name="knob")
        status, text = page.ask("save")
        assert (status, "params.yaml: expected YAML, got" in json.loads(text)["error"]) == (400, True)
        assert len(page.answer("start")["marks"]) == 2
    assert ReferenceKeypoints(pickable_copy.path(ReferenceKeypoints, variant="hand")).names == ["rim"]
    (pickable_copy.root / "params.yaml").rmdir()


def test_parameters_are_as_they_were_if_the_artifact_cannot_be_made(pickable_copy) -> None:
    with Page(pickable_copy) as page:
        click(page, name="rim")
        page.answer("save")
        before = (pickable_copy.root / "params.yaml").read_bytes()
        click(page, name="knob")
        shutil.rmtree(pickable_copy.path(VisibleMasks, "a"))
        assert page.ask("save")[0] == 400
    assert (pickable_copy.root / "params.yaml").read_bytes() == before


@pytest.mark.parametrize("is_saved", [True, False])
def test_ctrl_c_ends_as_finish_does_once_something_was_saved(pickable_copy, monkeypatch, is_saved: bool) -> None:
    def interrupted(desk: Desk, port: int, opened: object) -> None:
        at = FramePixel(frame=frame("a", 1), u=40.0, v=50.0)
        desk.edit(EditRequest(do="add", at=at))
        if is_saved:
            desk.save(EmptyRequest())
        raise KeyboardInterrupt  # As the server on Ctrl-C; the process of the tests may ignore a real signal.

    monkeypatch.setattr("bask_data.picker.serve", interrupted)
    ended = CliRunner().invoke(app, ["reference", str(pickable_copy.root), "--pick", "--no-browser"])
    assert pickable_copy.path(ReferenceKeypoints).exists() == is_saved
    if is_saved:
        assert ended.exit_code == 0, ended.stderr
        assert "interrupted" not in ended.stderr
        assert "made" in ended.stderr
        assert f"next: bask-data encode {pickable_copy.root}" in ended.stderr
    else:
        assert ended.exit_code == 130
        assert "nothing was saved; the picks are kept, and the same command continues with them." in ended.stderr
        assert list((pickable_copy.root / SCRATCH).glob("picks*.json"))


@pytest.mark.parametrize("is_other_file", [True, False])
def test_picks_are_up_to_date_without_options_whatever_was_given_before(
    pickable_copy, monkeypatch, tmp_path, is_other_file: bool
) -> None:
    def saved(desk: Desk, port: int, opened: object) -> None:
        desk.edit(EditRequest(do="add", at=FramePixel(frame=frame("a", 1), u=40.0, v=50.0)))
        desk.save(EmptyRequest())

    def command(*words: object) -> None:
        ended = CliRunner().invoke(app, ["reference", str(pickable_copy.root), *map(str, words)])
        assert ended.exit_code == 0, ended.stderr
        [standing] = status(Dataset(pickable_copy.root), STAGES, RunRequest(stages=("reference",)))
        assert (standing.state.status, standing.state.why) == ("up to date", "")

    monkeypatch.setattr("bask_data.picker.serve", saved)
    file = tmp_path / "other.yaml"
    file.write_text("reference: {seed: 1}\n")
    picking = ["--pick", "--no-browser", *(["--config", file] if is_other_file else [])]
    command(*picking)
    command("--auto", "--n", 2)
    command(*picking)
    assert len(ReferenceKeypoints(pickable_copy.path(ReferenceKeypoints)).picks) > 0


def test_ctrl_c_during_a_save_waits_for_its_end(pickable_copy, monkeypatch) -> None:
    reached, interrupted = threading.Event(), threading.Event()
    saved = bask_data.picker._saved

    def slow(picking: Picking, picks: list[str]) -> Outcome:
        reached.set()
        assert interrupted.wait(60)
        return saved(picking, picks)

    def left_running(desk: Desk, port: int, opened: object) -> None:
        desk.edit(EditRequest(do="add", at=FramePixel(frame=frame("a", 1), u=40.0, v=50.0)))
        threading.Thread(target=desk.save, args=[EmptyRequest()]).start()
        assert reached.wait(60)
        threading.Timer(0.5, interrupted.set).start()
        raise KeyboardInterrupt

    monkeypatch.setattr("bask_data.picker.serve", left_running)
    monkeypatch.setattr("bask_data.picker._saved", slow)
    ended = CliRunner().invoke(app, ["reference", str(pickable_copy.root), "--pick", "--no-browser"])
    assert ended.exit_code == 0, ended.stderr
    assert "waiting for the end of save" in ended.stderr and "interrupted" not in ended.stderr
    assert "made" in ended.stderr and not list((pickable_copy.root / SCRATCH).glob("picks*.json"))


def picked(dataset: Dataset, **options: object) -> None:
    planned = plan(dataset, reference, options=options)[0]
    picking = Picking(dataset, lambda values: planned, dataset.root / "params.yaml", "")
    pick_keypoints(picking, say=print, opened=print)


def test_a_missing_network_is_reported_with_a_fix(pickable_copy) -> None:
    shutil.rmtree(pickable_copy.path(DescriptorNet))
    with pytest.raises(BadData, match=r"descriptor/main: expected a network, got none.  fix: bask-data train"):
        picked(pickable_copy)


def test_missing_recordings_are_reported_with_a_fix(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"expected a recording, got none in the dataset.  fix: bask-data ingest"):
        picked(Dataset.create(tmp_path / "empty"))


def test_without_objects_there_is_nothing_to_propose(pickable_copy) -> None:
    for name in ("a", "b"):
        without_objects(pickable_copy, name)
    with pytest.raises(UsageError, match="--auto: expected a scan with masks of its objects, got none"):
        picked(pickable_copy, auto=True)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--port", "8000"], "--port: expected --pick as well, got --port alone"),
        (["--pick", "--dry-run"], "expected --dry-run without --pick, got both"),
        (["--pick", "--port", "70000"], "--port: expected a whole number of at least 0 and at most 65535, got '70000'"),
    ],
)
def test_options_that_exclude_each_other_are_refused(pickable_copy, options: list[str], message: str) -> None:
    ended = CliRunner().invoke(app, ["reference", str(pickable_copy.root), *options])
    assert (ended.exit_code, message in ended.stderr) == (2, True), ended.stderr
