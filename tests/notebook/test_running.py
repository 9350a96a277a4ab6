from __future__ import annotations

import io
import json
import shutil
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

import bask_data as bask
from bask_data.artifact import read_manifest
from bask_data.cli.app import app
from bask_data.dataset import Dataset
from bask_data.errors import BadData, UsageError
from tests.tiny import PARAMS, write_recording

SCAN = ("reconstruct", "objects", "masks")


def command(*words: object) -> str:
    answer = CliRunner().invoke(app, [str(word) for word in words])
    assert answer.exit_code == 0, answer.output
    return answer.stdout


@pytest.fixture(scope="module")
def with_masks(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset that the command line made up to its masks, with parameters in its own file and one given once."""
    folder = tmp_path_factory.mktemp("running")
    options = write_recording(folder / "files")
    command("ingest", "frames", folder / "files", folder / "d", "--scene", "table1", *options)
    (folder / "d" / "params.yaml").write_text("correspondences: {n_matches: 30}\n")
    command("reconstruct", folder / "d", "--voxel-size", "0.008")
    for stage in SCAN[1:]:
        command(stage, folder / "d")
    return folder / "d"


@pytest.fixture
def root(with_masks: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(with_masks, tmp_path / "d"))


def statuses(standings) -> dict[str, str]:
    return {one.label: one.state.status for one in standings}


def test_run_uses_and_records_parameters_as_the_command_does(root: Path, tmp_path: Path) -> None:
    other = Path(shutil.copytree(root, tmp_path / "other"))
    command("correspondences", other, "--n-pairs", "4")
    [outcome] = bask.open(root).run("correspondences", n_pairs=4)
    assert outcome.status == "made"
    made, theirs = (read_manifest(one / "correspondences" / "table1") for one in (root, other))
    assert made.params == theirs.params and made.params["n_matches"] == 30 and made.params["n_pairs"] == 4
    assert (made.key, made.digest) == (theirs.key, theirs.digest)
    recorded = json.loads((root / "requested.json").read_text())
    assert recorded == json.loads((other / "requested.json").read_text())
    assert recorded["parameters"]["correspondences"] == {"n_pairs": 4}
    [again] = bask.open(root).run("correspondences")
    assert again.status == "up to date"
    [forced] = bask.open(root).run("correspondences", force=True)
    assert (forced.status, forced.digest) == ("made", outcome.digest)


def test_run_without_a_stage_makes_whatever_is_missing(root: Path) -> None:
    own = {name: PARAMS[name] for name in ("correspondences", "train", "reference")}
    (root / "params.yaml").write_text(json.dumps(own))
    outcomes = bask.open(root).run()
    assert [(outcome.label, outcome.status) for outcome in outcomes] == [
        *((f"{stage} table1", "up to date") for stage in SCAN),
        ("correspondences table1", "made"),
        ("train", "made"),
        ("reference", "made"),
    ]
    assert {*statuses(bask.open(root).status()).values()} == {"up to date"}


def test_status_says_what_the_command_says(root: Path) -> None:
    ds = bask.open(root)
    assert statuses(ds.status()) == {
        **{f"{stage} table1": "up to date" for stage in SCAN},
        "correspondences table1": "missing",
        "train": "blocked",
        "reference": "blocked",
    }
    told = command("status", root, "--all")
    assert [f"{one.state.status} {one.label}" in " ".join(told.split()) for one in ds.status()] == [True] * 6
    assert statuses(ds.status("train")) == {"train": "blocked"}
    assert statuses(ds.status(["masks", "train"], only="table1")) == {"masks table1": "up to date", "train": "blocked"}
    bask.open(root).run("reconstruct", voxel_size=0.01)
    assert ds.status("objects")[0].state.status == "stale"


def test_standings_and_outcomes_print_as_lines_and_as_a_table(root: Path) -> None:
    ds = bask.open(root)
    standings = ds.status()
    assert repr(standings).splitlines()[:2] == ["up to date  reconstruct table1", "up to date  objects table1"]
    assert "blocked     train  (" in repr(standings) and max(map(len, repr(standings).splitlines())) < 150
    html = standings._repr_html_()
    assert html.count("<tr>") == 1 + len(standings) and f">{standings[-1].state.blocked.fix}</td>" in html
    outcomes = ds.run("masks")
    assert repr(outcomes).startswith("up to date  masks table1")
    assert outcomes._repr_html_().count("<tr>") == 2 and ">masks table1</td>" in outcomes._repr_html_()


def test_nothing_to_make_is_said(tmp_path: Path) -> None:
    ds = bask.open(Dataset.create(tmp_path / "d").root)
    assert repr(ds) == f"<dataset d at {tmp_path / 'd'}: no recordings>"
    assert not [one for one in ds.status() if one.item]
    with pytest.raises(UsageError, match=r"expected a scene, got none in the dataset\.  fix: bask-data ingest --help"):
        ds.run("masks")


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        (lambda ds: ds.run("mask"), "stage: expected one of reconstruct, .*, got mask.  fix: did you mean masks"),
        (
            lambda ds: ds.run(noise=1),
            "run: expected parameters or a variant of a named stage, got noise without a stage",
        ),
        (lambda ds: ds.run(variant="big"), "run: expected parameters or a variant of .*, got variant without a stage"),
        (lambda ds: ds.status("mask"), "stage: expected one of reconstruct, .*, got mask"),
        (lambda ds: ds.status(only="table2"), "only: expected one of table1, got table2"),
        (lambda ds: ds.run("masks", noise=1), "masks: noise: expected no field of that name, got 1.  fix: one of "),
        (lambda ds: ds.run("correspondences", n_pairs="many"), "n_pairs: expected a whole number, got 'many'"),
        (
            lambda ds: ds.run("reference", descriptor="big"),
            "reference: expected its inputs, got descriptor/big",
        ),
    ],
)
def test_what_cannot_be_run_is_said_with_what_can(with_masks: Path, asked, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        asked(bask.open(with_masks))


def test_what_commands_beside_a_notebook_do_is_seen(root: Path, tmp_path: Path) -> None:
    ds = bask.open(root)
    options = write_recording(tmp_path / "more", seed=1)
    command("ingest", "frames", tmp_path / "more", root, "--scene", "table2", *options)
    assert list(ds.scans) == ["table1", "table2"] and len(ds.scans["table2"]) == 8
    (root / "dataset.json").unlink()
    with pytest.raises(BadData, match="expected a dataset"):
        _ = ds.scans


def test_a_relative_root_stays_where_it_was(root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(root.parent)
    ds = bask.open(root.name)
    monkeypatch.chdir("/")
    assert ds.root == root and len(ds.scans["table1"][0].rgb)
    monkeypatch.setenv("HOME", str(tmp_path))
    assert bask.open("~/d").root == tmp_path / "d"


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_a_run_shows_how_it_goes_on_stderr(root: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    ds = bask.open(root)
    capsys.readouterr()
    ds.run("masks", force=True)
    shown = capsys.readouterr()
    assert shown.out == "" and shown.err.startswith("made        masks table1") and "\r" not in shown.err
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    ds.run("masks", force=True)
    text = terminal.getvalue()
    assert "0/8" in text and text.index("0/8") < text.index("made        masks table1")
    assert text.rpartition("\n")[2] == "" and len(text.splitlines()[-1]) < 100
