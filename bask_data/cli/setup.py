"""Commands about this machine: `doctor` and `completion`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from bask_data.cli.commands import CommandList
from bask_data.cli.options import Json
from bask_data.errors import MissingDependency

app = CommandList()


@app.command(
    epilog="""
    bask-data doctor
    bask-data doctor --folder /data
    """
)
def doctor(
    folder: Annotated[Path | None, typer.Option(help="Where datasets will go: is there room?", metavar="DIR")] = None,
    json_: Json = False,
) -> None:
    """Say what this machine lacks, and the line that brings it.

    Leaves with exit code 5 if something that every command needs is missing.
    """
    from bask_data import doctor as examiner

    found = examiner.checks(folder)
    print(examiner.as_json(found) if json_ else examiner.render(found))
    if examiner.missing(found):
        raise typer.Exit(MissingDependency.exit_code)


@app.command(
    epilog="""
    bask-data completion bash >> ~/.bashrc
    bask-data completion zsh > ~/.zfunc/_bask-data
    bask-data completion fish > ~/.config/fish/completions/bask-data.fish
    """
)
def completion(shell: Annotated[Literal["bash", "zsh", "fish"], typer.Argument(help="The shell.")]) -> None:
    """Print the script that makes the Tab key complete commands and names.

    Run the line of your shell below once and open a new terminal. Tab then completes commands and options, scenes and
    demonstrations after --only, variants after --variant, and parameters after --set; where names belong to a dataset,
    its ROOT has to stand before them. zsh reads ~/.zfunc where ~/.zshrc has `fpath+=~/.zfunc; autoload -Uz compinit;
    compinit`.
    """
    from bask_data.cli.completion import script

    print(script(shell))
