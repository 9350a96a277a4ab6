"""Commands for setting up a machine: `doctor` and `completion`."""

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
    folder: Annotated[
        Path | None, typer.Option(help="Folder for datasets, to check for free space.", metavar="DIR")
    ] = None,
    json_: Json = False,
) -> None:
    """Check this machine, and print how to install what is missing.

    Exits with code 5 if something that every command needs is missing.
    """
    from bask_data.doctor import machine as examiner

    checks = examiner.checks(folder)
    print(examiner.as_json(checks) if json_ else examiner.render(checks))
    if examiner.missing(checks):
        raise typer.Exit(MissingDependency.exit_code)


@app.command(
    epilog="""
    bask-data completion bash >> ~/.bashrc
    bask-data completion zsh > ~/.zfunc/_bask-data
    bask-data completion fish > ~/.config/fish/completions/bask-data.fish
    """
)
def completion(shell: Annotated[Literal["bash", "zsh", "fish"], typer.Argument(help="The shell.")]) -> None:
    """Print the shell script for completion of commands and names.

    Run the line for your shell below once and open a new terminal. Tab then completes commands and options, scenes and
    demonstrations after --only, variants after --variant, and parameters after --set; names in a dataset are completed
    once its ROOT is on the line. zsh reads ~/.zfunc if ~/.zshrc contains `fpath+=~/.zfunc; autoload -Uz compinit;
    compinit`.
    """
    from bask_data.cli.completion import script

    print(script(shell))
