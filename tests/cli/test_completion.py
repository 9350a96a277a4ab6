from __future__ import annotations

import json
import os
import pty
import re
import select
import shlex
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest
from typer.testing import CliRunner

from bask_data.cli.app import app
from bask_data.formats import FORMATS

BASH = shutil.which("bash")
pytestmark = pytest.mark.skipif(BASH is None, reason="no bash")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A program `bask-data`, the script of its completion and a dataset `d` with names."""
    folder = tmp_path_factory.mktemp("completion")
    program = folder / "bin" / "bask-data"
    program.parent.mkdir()
    program.write_text(f'#!/bin/sh\nexec {shlex.quote(sys.executable)} -m bask_data.cli "$@"\n')
    program.chmod(0o755)
    (folder / "completion.sh").write_text(CliRunner().invoke(app, ["completion", "bash"]).stdout)
    source = {"format": "frames", "path": "x"}
    content = {
        "name": "d",
        "scenes": {"table1": source, "table2": source},
        "demonstrations": {"pour1": source},
        "variants": {"descriptor": {"quick": {}}, "keypoints": {"discrete": {}}},
    }
    (folder / "d").mkdir()
    (folder / "d" / "dataset.json").write_text(json.dumps(content))
    return folder


def environment(folder: Path) -> dict[str, str]:
    path = f"{folder / 'bin'}:{os.environ['PATH']}"
    return {**os.environ, "PATH": path, "PYTHONPATH": os.pathsep.join(sys.path), "PS1": "$ ", "TERM": "dumb"}


def completed(folder: Path, line: str) -> list[str]:
    """What bash offers for the last word of a line, by the function that it would call."""
    words = line.split(" ")
    script = (
        f"source completion.sh; COMP_WORDS=({shlex.join(words)}); COMP_CWORD={len(words) - 1}; "
        "_bask_data_completion bask-data 2>/dev/null; printf '%s\\n' \"${COMPREPLY[@]}\""
    )
    ended = subprocess.run(
        [BASH or "", "--norc", "-c", script], cwd=folder, env=environment(folder), capture_output=True, text=True
    )
    assert ended.returncode == 0, ended.stderr
    return ended.stdout.split()


@pytest.mark.parametrize(
    ("line", "offered"),
    [
        ("bask-data sta", ["status"]),
        ("bask-data re", ["refine", "reconstruct", "reference", "report"]),
        ("bask-data ingest ", ["auto", *(format.name for format in FORMATS), "sim"]),
        ("bask-data run d --only ", ["table1", "table2", "pour1"]),
        ("bask-data run d --only table1,", ["table1,table2", "table1,pour1"]),
        ("bask-data reconstruct d --only ", ["table1", "table2"]),
        ("bask-data encode d --only ", ["pour1"]),
        ("bask-data encode d --descriptor ", ["main", "quick"]),
        ("bask-data encode d --variant ", ["main", "discrete"]),
        ("bask-data run d --set train.st", ["train.steps="]),
        ("bask-data train d --loss ", ["infonce", "contrastive"]),
        ("bask-data train d --ste", ["--steps"]),
        ("bask-data run none --only ", []),
    ],
)
def test_bash_completes_commands_options_and_names(folder: Path, line: str, offered: list[str]) -> None:
    assert completed(folder, line) == offered


def test_all_stages_are_offered_to_set(folder: Path) -> None:
    assert {name.split(".")[0] for name in completed(folder, "bask-data status d --set ")} == {
        "reconstruct",
        "objects",
        "masks",
        "correspondences",
        "identify",
        "train",
        "reference",
        "encode",
    }


def test_tab_completes_in_an_interactive_bash(folder: Path) -> None:
    process, terminal = pty.fork()
    if process == 0:  # pragma: no cover  # It becomes bash.
        os.chdir(folder)
        os.execve(BASH or "", ["bash", "--norc", "--noprofile", "-i"], environment(folder))
    try:
        os.write(terminal, b"source completion.sh; echo ready\n")
        until(terminal, r"\nready\r\n")
        os.write(terminal, b"bask-data val\t")
        until(terminal, "bask-data validate ")
        os.write(terminal, b"\x15bask-data run d --set reconstruct.vox\t003")
        until(terminal, r"reconstruct\.voxel_size=003")  # No space where a value follows.
    finally:
        os.close(terminal)
        os.waitpid(process, 0)


def until(terminal: int, pattern: str) -> None:
    """Read what is shown until it matches."""
    text, end = "", time.monotonic() + 60
    while time.monotonic() < end:
        if select.select([terminal], [], [], 0.2)[0]:
            text += os.read(terminal, 4096).decode(errors="replace")
        if re.search(pattern, text):
            return
    raise AssertionError(f"{pattern!r} did not come, but {text!r}")


@pytest.mark.parametrize("shell", ["zsh", "fish"])
def test_scripts_of_other_shells_ask_the_program(shell: str) -> None:
    shown = CliRunner().invoke(app, ["completion", shell])
    assert shown.exit_code == 0
    assert f"_BASK_DATA_COMPLETE=complete_{shell}" in shown.stdout
