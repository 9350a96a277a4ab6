"""The help of every command as text files in `tests/cli/help/`, so that a change of a word is seen in a review.

`python -m tests.cli.help_texts` writes them anew, with `--check` it only says which are not as the code has them.
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
    """The words of every command and group, the program's own help first."""
    yield path
    if hasattr(command, "list_commands"):
        for name in command.list_commands(None):
            yield from commands(command.get_command(None, name), (*path, name))


def rendered() -> dict[str, str]:
    """File name to text."""
    environment = {"COLUMNS": COLUMNS, "NO_COLOR": "1"}
    texts = {}
    for path in commands(get_command(app)):
        shown = CliRunner(env=environment).invoke(app, [*path, "--help"], prog_name="bask-data")
        assert shown.exit_code == 0, shown.output
        texts["-".join(("bask-data", *path)) + ".txt"] = shown.stdout
    return texts


def changed() -> list[str]:
    """Names of files that are not as rendered, or that no command has."""
    texts = rendered()
    there = {file.name: file.read_text() for file in FOLDER.glob("*.txt")}
    return sorted(name for name in {*texts, *there} if texts.get(name) != there.get(name))


def main(arguments: list[str]) -> int:
    """Write the files, or with `--check` say which differ; exit code 1 then."""
    names = changed()
    if arguments == ["--check"]:
        print("\n".join(f"{name}: differs.  fix: python -m tests.cli.help_texts" for name in names) or "help: as it is")
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
