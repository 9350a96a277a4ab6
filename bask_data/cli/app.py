"""The command `bask-data`: what commands there are, and what all of them share."""

from __future__ import annotations

import os
import signal
import sys
from typing import Annotated

import typer

from bask_data import __version__
from bask_data.cli import completion
from bask_data.cli.commands import HELP_FLAGS, BaskGroup, CommandList, under
from bask_data.errors import UsageError

COMMANDS = (
    *under(
        "Recordings",
        ("init", "datasets", "Make an empty dataset."),
        ("ingest", "ingest", "Read a recording into a dataset; one sub-command per format."),
        ("split", "datasets", "Say which scenes are for training, validation and test."),
    ),
    *under(
        "Pipeline",
        ("run", "pipeline", "Make everything that is missing or stale, in order."),
        ("status", "pipeline", "Say what is up to date, and of what is not, why."),
        ("reconstruct", "stages", "Fuse a scan's depth images into a triangle mesh."),
        ("objects", "stages", "Split the surface into the objects on its support and the background."),
        ("masks", "stages", "Project the objects into every frame, hidden parts left out."),
        (
            "correspondences",
            "stages",
            "Match pixels of the objects between pairs of frames that see them from different places.",
        ),
        ("train", "stages", "Train a Dense Object Net on the matches of all scans."),
        ("reference", "stages", "Choose reference keypoints and keep their descriptors."),
        ("encode", "stages", "Track the reference keypoints through a demonstration, in 3D."),
    ),
    *under(
        "Look",
        ("report", "show", "Write one HTML page with pictures of everything the dataset holds, and how good it is."),
        ("view", "show", "Walk through scenes and demonstrations in the Rerun viewer, or save what it shows."),
        ("evaluate", "evaluate", "Compare what was made with the ground truth of recordings that have it."),
    ),
    *under(
        "Dataset",
        ("info", "datasets", "Say what a dataset holds."),
        ("validate", "datasets", "Check every file against its SHA-256 and every array against its schema."),
    ),
    *under(
        "Share",
        ("export", "share", "Write demonstrations with their keypoints as the files that policies learn from."),
        ("dvc", "share", "Write dvc.yaml and params.yaml, so that `dvc repro` runs and records the pipeline."),
    ),
    *under(
        "Set-up",
        ("doctor", "setup", "Say what this machine lacks, and the line that brings it."),
        ("completion", "setup", "Print the script that makes the Tab key complete commands and names."),
    ),
)
"""What `bask-data --help` lists: the name of a command, its module and the first sentence of its help."""


class BaskData(BaskGroup):
    """All commands."""

    entries = COMMANDS


app = CommandList(
    name=completion.PROGRAM,
    cls=BaskData,
    no_args_is_help=True,
    context_settings=HELP_FLAGS,
    help="RGB-D scans in; object masks, dense correspondence and Bayesian scene keypoints out.\n\n"
    "A dataset is a directory: `ingest` fills it, `run` makes everything else from it, `status` says what is stale.",
    epilog="""
    bask-data ingest frames recordings/table data/demo --scene table
    bask-data run data/demo
    bask-data status data/demo
    bask-data report data/demo
    """,
)


def main() -> None:
    """Run the command line and leave with the documented exit code."""
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    if completion.VARIABLE in os.environ:
        completion.prepare()
    # One name, however it was started: messages name commands that can be typed.
    app(prog_name=completion.PROGRAM)


@app.callback(invoke_without_command=True)
def version_or_command(
    context: typer.Context, version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False
) -> None:
    """Print the version, or go on to the command; `UsageError` if torchrun started one that works alone."""
    if version:
        print(f"bask-data {__version__}")
        raise typer.Exit
    if "TORCHELASTIC_RUN_ID" in os.environ:
        refuse_alone(context.invoked_subcommand)


def refuse_alone(command: str | None) -> None:
    """`UsageError` for a command that several processes of torchrun cannot share."""
    from bask_data.engine import processes
    from bask_data.pipeline import STAGES

    able = [stage.name for stage in STAGES if stage.together]
    if processes() > 1 and command not in able:
        raise UsageError("torchrun", "command", expected=" or ".join(able), got=command)
