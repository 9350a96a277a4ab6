from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from bask_data.cli.app import app
from bask_data.cli.console import duration
from bask_data.cli.running import Course, summary
from bask_data.dataset import Dataset
from bask_data.engine import Outcome, Position
from bask_data.engine.forecast import Forecast
from tests.datasets import add_scan

ROWS = [
    ("reconstruct", "reconstruct a", "up to date", ""),
    *(("reconstruct", f"reconstruct {name}", "stale", "changed: far 4 -> 5") for name in "bcde"),
    ("objects", "objects a", "missing", ""),
    ("objects", "objects b", "blocked", "reconstruction/b is missing"),
]


@pytest.fixture
def five_scans(tmp_path: Path) -> Dataset:
    dataset = Dataset.create(tmp_path / "table")
    for name in ("a", "b", "c", "d", "e"):
        add_scan(dataset, name)
    return dataset


def program(*arguments: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-m", "bask_data.cli", *map(str, arguments)], capture_output=True, text=True)


def test_a_summary_counts_and_names_the_first_that_are_not_up_to_date() -> None:
    assert summary(ROWS, every=False) == [
        "  reconstruct      1 up to date, 4 stale",
        "    stale       reconstruct b  (changed: far 4 -> 5)",
        "    stale       reconstruct c  (changed: far 4 -> 5)",
        "    stale       reconstruct d  (changed: far 4 -> 5)",
        "    ... and 1 more; --all lists them",
        "  objects          1 missing, 1 blocked",
        "    missing     objects a",
        "    blocked     objects b  (reconstruction/b is missing)",
    ]
    assert len(summary(ROWS, every=True)) == len(ROWS)


def test_status_is_a_result_on_stdout_and_the_next_command_is_not(five_scans: Dataset) -> None:
    ended = program("status", five_scans.root)
    assert ended.returncode == 0
    assert ended.stdout.splitlines()[0] == "  reconstruct      5 missing"
    assert "... and 2 more; --all lists them" in ended.stdout
    assert ended.stderr == f"next: bask-data run {five_scans.root}\n"
    every = program("status", five_scans.root, "--all")
    assert sum("reconstruct " in line for line in every.stdout.splitlines()) == 5


@pytest.mark.parametrize("command", ["status", "info", "validate", "split", "init"])
def test_with_json_stdout_holds_nothing_else(five_scans: Dataset, command: str, tmp_path: Path) -> None:
    root = tmp_path / "new" if command == "init" else five_scans.root
    ended = CliRunner().invoke(app, [command, str(root), "--json"])
    assert ended.exit_code == 0
    assert json.loads(ended.stdout)["command"] == command


@pytest.mark.parametrize(
    ("command", "line"),
    [
        ("info", "table: 5 scenes, 0 demonstrations, licence not stated"),
        ("validate", "5 artifacts, no problems."),
        ("split", "  validation: b"),
    ],
)
def test_results_are_on_stdout(five_scans: Dataset, command: str, line: str) -> None:
    words = [command, str(five_scans.root), *(["--validation", "b"] if command == "split" else [])]
    assert line in CliRunner().invoke(app, words).stdout.splitlines()


def test_a_dry_run_is_a_summary_and_lists_all_on_demand(five_scans: Dataset) -> None:
    runner = CliRunner()
    ended = runner.invoke(app, ["run", str(five_scans.root), "--dry-run"])
    assert ended.stdout.splitlines()[0] == "  reconstruct      5 would make"
    assert ended.stderr == "next: the same without --dry-run\n"
    every = runner.invoke(app, ["run", str(five_scans.root), "--dry-run", "--all"])
    assert "  would make  objects e  (after reconstruction/e)" in every.stdout.splitlines()


def test_a_run_shows_its_position_and_the_time_left(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    def outcome(kind: str, item: str, status: str, seconds: float = 0.0) -> Outcome:
        path = str(tmp_path / kind / item)
        return Outcome(f"{kind} {item}", kind, item, "main", path, status, seconds=seconds)  # type: ignore[arg-type]

    predicted = [outcome("masks", name, "would make") for name in "abc"] + [outcome("masks", "d", "up to date")]
    course = Course(Forecast(tmp_path, predicted), is_pipeline=True)
    course.begin(Position("masks", "main", 3, 7, "a", 1, 4))
    list(course.shown([outcome("masks", "a", "failed", 100.0)]))
    course.begin(Position("masks", "main", 3, 7, "d", 4, 4))
    list(course.shown([outcome("masks", "d", "up to date")]))
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "  stage 3 of 7: masks a (1 of 4)"
    assert lines[-1] == "  up to date  1 masks"
    assert not any("masks d" in line for line in lines), "what is up to date is counted"
    course = Course(Forecast(tmp_path, predicted), is_pipeline=False)
    course._forecast.count(outcome("masks", "earlier", "made", 40.0))
    course.begin(Position("masks", "main", 1, 1, "", 1, 4))
    assert capsys.readouterr().err == "  masks (4 items), about 2 min 0 s left\n"


def test_an_item_that_may_be_remade_is_announced(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    path = str(tmp_path / "masks" / "a")
    course = Course(Forecast(tmp_path, [Outcome("masks a", "masks", "a", "main", path, "may make")]), is_pipeline=True)
    course.begin(Position("masks", "main", 3, 7, "a", 1, 1))
    assert capsys.readouterr().err == "  stage 3 of 7: masks a\n"


@pytest.mark.parametrize(("seconds", "words"), [(3.14, "3.1 s"), (75, "1 min 15 s"), (7500, "2 h 5 min")])
def test_durations_are_printed_in_readable_units(seconds: float, words: str) -> None:
    assert duration(seconds) == words
