from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from bask_data.cli.app import app

FORM = re.compile(r"error: [^:]+: (\S+: )?expected .+, got .+\.  fix: .+")
"""Of every error: where, the option or argument if it is one, expected, got, fix."""


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("train", "bask-data train: ROOT: expected the dataset's directory, got none."),
        ("ingest tum . d", "bask-data ingest tum: --scene: expected name of the recording in the dataset, got none."),
        (
            "ingest sim d",
            "bask-data ingest sim: --task: expected one of microwave, lid, phone, rubbish, drawer, mug, got none.",
        ),
        ("ingest tum no/such d --scene a", "SOURCE: expected a directory that exists, got 'no/such'.  fix: check"),
        ("train d --steps abc", "bask-data train: --steps: expected a whole number, got 'abc'."),
        ("train d --steps", "bask-data train: --steps: expected a whole number, got none."),
        ("train d --learning-rate x", "--learning-rate: expected a number, got 'x'."),
        ("run d --jobs 0", "bask-data run: --jobs: expected a whole number of at least 1, got '0'."),
        ("view d --port 70000", "--port: expected a whole number of at least 1 and at most 65534, got '70000'."),
        ("train d --loss infoncee", "got 'infoncee'.  fix: did you mean infonce?"),
        (
            "train d --stepz 3",
            "bask-data train: expected an option of this command, got --stepz.  fix: did you mean --s",
        ),
        ("train d --voxel-size 3", "got --voxel-size.  fix: see `bask-data train --help`."),
        ("train d -x", "bask-data train: expected an option of this command, got -x."),
        ("status d --json=1", "bask-data status: --json: expected no value, got a value.  fix: write --json alone."),
        ("train d more words", "bask-data train: expected ROOT and nothing more, got more words."),
        ("trian d", "bask-data: expected one of its commands, got trian.  fix: did you mean train?"),
        ("ingest fames . d", "bask-data ingest: expected one of its commands, got fames.  fix: did you mean frames?"),
        ("blow-up d", "got blow-up.  fix: `bask-data --help` lists the commands."),
        ("--nope", "bask-data: expected an option of this command, got --nope."),
        ("export csv d out", "FORMAT: expected one of parquet, lerobot, robomimic, diffusion-policy, got 'csv'."),
    ],
)
def test_errors_of_the_parser_have_our_form(line: str, message: str) -> None:
    ended = CliRunner().invoke(app, line.split(), prog_name="bask-data")
    assert ended.exit_code == 2
    assert ended.stdout == ""
    assert message in ended.stderr
    assert FORM.fullmatch(ended.stderr.strip()), ended.stderr


@pytest.mark.parametrize(
    ("assignment", "message"),
    [
        ("recontruct.voxel_size=1", "fix: did you mean reconstruct?"),
        ("reconstruct.voxel=1", "reconstruct.voxel: expected one of voxel_size, "),
        ("reconstruct.voxel=1", "fix: did you mean voxel_size?"),
        ("reconstruct@a.voxelsize=1", "fix: did you mean voxel_size?"),
        ("voxel_size", "--set: expected stage.field=value, got voxel_size.  fix: for instance --set"),
        ("train.steps=many", "train: steps: expected a whole number, got 'many'."),
    ],
)
def test_misspelt_parameter_gets_a_suggestion(tmp_path: Path, assignment: str, message: str) -> None:
    runner = CliRunner()
    assert runner.invoke(app, ["init", str(tmp_path / "d")]).exit_code == 0
    (tmp_path / "d" / "dataset.json").write_text('{"name": "d", "scenes": {"a": {"format": "frames", "path": "x"}}}')
    ended = runner.invoke(app, ["status", str(tmp_path / "d"), "--set", assignment])
    assert ended.exit_code == 2
    assert message in ended.stderr


def test_usage_errors_of_the_program_itself_exit_with_2() -> None:
    ended = subprocess.run([sys.executable, "-m", "bask_data.cli", "--nope"], capture_output=True, text=True)
    assert (ended.returncode, ended.stdout) == (2, "")
    message = "error: bask-data: expected an option of this command, got --nope."
    assert ended.stderr == f"{message}  fix: see `bask-data --help`.\n"


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="a folder in which nothing can be created")
def test_errors_of_the_system_have_our_form() -> None:
    ended = CliRunner().invoke(app, ["init", "/proc/x"], prog_name="bask-data")
    assert ended.exit_code == 1
    assert ended.stderr.startswith("error: /proc/x: expected a file or device to read or write, got no such file")
    assert FORM.fullmatch(ended.stderr.strip()), ended.stderr


def test_closed_stdout_is_no_error(tmp_path: Path) -> None:
    line = f"{sys.executable} -m bask_data.cli init {tmp_path / 'd'} >&-"
    assert subprocess.run(["sh", "-c", line], check=False).returncode == 0
