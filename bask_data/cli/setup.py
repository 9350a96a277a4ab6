"""Commands for setting up a machine: `completion`."""

from __future__ import annotations

from typing import Annotated, Literal

import typer

from bask_data.cli.commands import CommandList

app = CommandList()


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
