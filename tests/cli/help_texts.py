"""Snapshots of the help of every command in `tests/cli/help/`, so that changes of wording show up in a review.

`python -m tests.cli.help_texts` renews them; with `--check` it only lists those that differ.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from typer.main import get_command
from typer.testing import CliRunner

from bask_data.cli.app import app

FOLDER = Path(__file__).parent / "help"
COLUMNS = "100"


def commands(command: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """Names of every command and group, as words; the program itself comes first."""
    yield path
    if hasattr(command, "list_commands"):
        for name in command.list_commands(None):
            yield from commands(command.get_command(None, name), (*path, name))


def rendered() -> dict[str, str]:
    """Help texts by file name."""
    environment = {"COLUMNS": COLUMNS, "NO_COLOR": "1"}
    texts = {}
    for path in commands(get_command(app)):
        shown = CliRunner(env=environment).invoke(app, [*path, "--help"], prog_name="bask-data")
        assert shown.exit_code == 0, shown.output
        texts["-".join(("bask-data", *path)) + ".txt"] = shown.stdout
    return texts


def changed() -> list[str]:
    """Names of snapshots that differ from the help, are missing, or belong to no command."""
    texts = rendered()
    snapshots = {file.name: file.read_text() for file in FOLDER.glob("*.txt")}
    return sorted(name for name in {*texts, *snapshots} if texts.get(name) != snapshots.get(name))


def main(arguments: list[str]) -> int:
    """Write the files, or with `--check` list those that differ, with exit code 1."""
    names = changed()
    if arguments == ["--check"]:
        print(
            "\n".join(f"{name}: differs.  fix: python -m tests.cli.help_texts" for name in names) or "help: up to date"
        )
        return 1 if names else 0
    texts = rendered()
    FOLDER.mkdir(exist_ok=True)
    for name in names:
        file = FOLDER / name
        file.write_text(texts[name]) if name in texts else file.unlink()
        print(os.path.relpath(file))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
