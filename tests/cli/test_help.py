from __future__ import annotations

import re
import shlex
import subprocess
import sys
from typing import Any

import pytest
from typer.main import get_command
from typer.testing import CliRunner

from bask_data.cli.app import COMMANDS, app
from bask_data.cli.panels import PANELS
from bask_data.formats import FORMATS
from bask_data.params import Params
from bask_data.pipeline import STAGES
from bask_data.sim.options import SimOptions
from tests.cli.help_texts import changed, commands, main, rendered


def shown(*words: str, columns: int = 100) -> str:
    ended = CliRunner(env={"COLUMNS": str(columns)}).invoke(app, [*words, "-h"], prog_name="bask-data")
    assert ended.exit_code == 0
    return ended.stdout


def command_of(words: list[str]) -> Any:
    command = get_command(app)
    for word in words:
        if not hasattr(command, "get_command") or (subcommand := command.get_command(None, word)) is None:
            break
        command = subcommand
    return command


def test_help_matches_its_snapshots() -> None:
    assert changed() == [], "if the change is wanted: python -m tests.cli.help_texts"


def test_changed_help_is_reported(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tests.cli.help_texts.COLUMNS", "60")
    assert main(["--check"]) == 1
    assert "bask-data-train.txt: differs.  fix: python -m tests.cli.help_texts" in capsys.readouterr().out


def test_list_of_commands_shows_the_first_sentence_of_their_help() -> None:
    for entry in COMMANDS:
        assert command_of([entry.name]).name == entry.name
        first = (command_of([entry.name]).help or "").split("\n\n")[0]
        assert entry.summary == " ".join(first.split())


def test_every_help_has_examples_of_commands_and_options_that_exist() -> None:
    for name, text in rendered().items():
        examples = text.partition("Examples:\n")[2].splitlines()
        assert examples, name
        for example in examples:
            words = shlex.split(re.split(r" [|>]", example)[0])
            if words[0] == "torchrun":
                words = words[words.index("bask_data.cli") :]
            command = command_of(words[1:])
            known = {flag for each in command.params for flag in (*each.opts, *each.secondary_opts)}
            assert {word for word in words if word.startswith("--")} <= known, example


def test_help_fills_the_terminal_up_to_a_readable_width() -> None:
    widest = {columns: max(map(len, shown("train", columns=columns).splitlines())) for columns in (70, 100, 400)}
    assert widest[100] > 90
    assert widest[400] <= 120
    assert max(len(line) for line in shown("split", columns=60).partition("Examples")[0].splitlines()) <= 60


def test_everyday_options_of_a_long_command_come_first() -> None:
    text = shown("train")
    order = ["Arguments:", "Options:", "--steps", "Loss:", "--alpha", "Augmentation:", "Workers:", "--json", "--help"]
    places = [text.index(word) for word in order]
    assert places == sorted(places)


def test_headings_name_fields_that_exist() -> None:
    models: dict[str, type[Params]] = {stage.name: stage.params for stage in STAGES}
    models |= {format.name: format.options for format in FORMATS} | {"sim": SimOptions}
    for command, panels in PANELS.items():
        named = [field for fields in panels.values() for field in fields]
        assert len(named) == len(set(named))
        assert set(named) <= set(models[command].model_fields), command


def test_both_flags_and_no_arguments_show_the_same_help() -> None:
    runner = CliRunner(env={"COLUMNS": "100"})
    assert runner.invoke(app, ["-h"]).stdout == runner.invoke(app, ["--help"]).stdout
    for words in ([], ["ingest"], ["evaluate"]):
        ended = runner.invoke(app, words)
        assert (ended.exit_code, ended.stdout) == (2, "")
        assert ended.stderr == runner.invoke(app, [*words, "-h"]).stdout


def test_help_and_version_load_no_command() -> None:
    code = (
        "import sys; from bask_data.cli.app import app; app(['--help'], standalone_mode=False); "
        "print([name for name in sys.modules if name == 'pydantic' or name.startswith('bask_data.stages')])"
    )
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ended.stdout.splitlines()[-1] == "[]"


def test_all_commands_are_found() -> None:
    names = {" ".join(path) for path in commands(get_command(app))}
    assert {"", "run", "ingest", "ingest sim", "evaluate keypoints", "completion"} <= names
    assert {stage.name for stage in STAGES} <= names
