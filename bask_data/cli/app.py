"""The command line: a command per stage, an `ingest` sub-command per format, and the dataset's commands. No logic."""

from __future__ import annotations

import signal
import sys
from typing import Annotated

import typer

from bask_data import __version__
from bask_data.cli import datasets, evaluate, ingest, pipeline, share, show, stages
from bask_data.cli.failures import reporting
from bask_data.engine import processes
from bask_data.errors import UsageError
from bask_data.pipeline import STAGES

app = typer.Typer(
    name="bask-data",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    help="RGB-D scans in; object masks, dense correspondence and Bayesian scene keypoints out.\n\n"
    "A dataset is a directory: `ingest` fills it, `run` makes everything else from it, `status` says what is stale.",
)


for _module in (stages, pipeline, datasets, show, share):
    app.add_typer(_module.app)
app.add_typer(ingest.app, name="ingest")
app.add_typer(evaluate.app, name="evaluate")


def main() -> None:
    """Run the command line and leave with the documented exit code."""
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    app()


@app.callback(invoke_without_command=True)
@reporting
def _version(
    context: typer.Context, version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False
) -> None:
    if version:
        print(f"bask-data {__version__}")
        raise typer.Exit
    able = [stage.name for stage in STAGES if stage.together]
    if processes() > 1 and context.invoked_subcommand not in able:
        raise UsageError("torchrun", "command", expected=" or ".join(able), got=context.invoked_subcommand)
