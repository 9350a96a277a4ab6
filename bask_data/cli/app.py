"""The program `bask-data`: the list of its commands, and the options that all share."""

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
        ("init", "datasets", "Create an empty dataset."),
        ("ingest", "ingest", "Read a recording into a dataset; one sub-command per format."),
        ("refine", "refining", "Look for errors in a scan's poses, and write a scan without them beside it."),
        ("split", "datasets", "Assign scenes to training, validation and test."),
    ),
    *under(
        "Pipeline",
        ("run", "pipeline", "Make everything that is missing or stale, in order."),
        ("status", "pipeline", "Show what is up to date and what is not, and why."),
        ("reconstruct", "stages", "Fuse a scan's depth images into a triangle mesh."),
        ("objects", "stages", "Split the surface into the objects on the support plane and the background."),
        ("masks", "stages", "Project the objects into every frame, without hidden parts."),
        (
            "correspondences",
            "stages",
            "Match pixels of the objects between pairs of frames that see them from different places.",
        ),
        ("identify", "stages", "Find out which objects of different scans are the same."),
        ("train", "stages", "Train a Dense Object Net on the matches of all scans."),
        ("reference", "stages", "Choose reference keypoints and store their descriptors."),
        ("encode", "stages", "Track the reference keypoints through a demonstration, in 3D."),
    ),
    *under(
        "Look",
        ("report", "show", "Write an HTML page with pictures and quality figures of everything in a dataset."),
        ("view", "show", "Show scenes and demonstrations in the Rerun viewer, or save them as a file."),
        ("evaluate", "evaluate", "Compare artifacts with ground truth, on recordings that have it."),
    ),
    *under(
        "Dataset",
        ("info", "datasets", "List the contents of a dataset."),
        ("validate", "datasets", "Check every file against its SHA-256 and every array against its schema."),
    ),
    *under(
        "Share",
        ("export", "share", "Write demonstrations and their keypoints in a format for policy learning."),
        ("dvc", "share", "Write dvc.yaml and params.yaml, to run the pipeline with `dvc repro`."),
    ),
    *under(
        "Set-up",
        ("doctor", "doctor", "Say what is wrong with a recording, a dataset or this machine, and how to mend it."),
        ("completion", "setup", "Print the shell script for completion of commands and names."),
    ),
)
"""The commands as `bask-data --help` lists them: name, module and first sentence of the help."""


class BaskData(BaskGroup):
    """All commands."""

    entries = COMMANDS


app = CommandList(
    name=completion.PROGRAM,
    cls=BaskData,
    no_args_is_help=True,
    context_settings=HELP_FLAGS,
    help="RGB-D scans in; object masks, dense correspondence and Bayesian scene keypoints out.\n\n"
    "A dataset is a directory: `ingest` adds recordings, `run` makes everything else, `status` shows what is stale.",
    epilog="""
    bask-data ingest frames recordings/table data/demo --scene table
    bask-data run data/demo
    bask-data status data/demo
    bask-data report data/demo
    """,
)


def main() -> None:
    """Run the command line and exit with the documented code."""
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    if completion.VARIABLE in os.environ:
        completion.prepare()
    # The same name however it was started: messages name commands that can be typed.
    app(prog_name=completion.PROGRAM)


@app.callback(invoke_without_command=True)
def version_or_command(
    context: typer.Context, version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False
) -> None:
    """Print the version, or go on to the command; `UsageError` if torchrun started one that cannot be distributed."""
    if version:
        print(f"bask-data {__version__}")
        raise typer.Exit
    if "TORCHELASTIC_RUN_ID" in os.environ:
        refuse_undistributed(context.invoked_subcommand)


def refuse_undistributed(command: str | None) -> None:
    """`UsageError` for a command that cannot be distributed over torchrun's processes."""
    from bask_data.engine import processes
    from bask_data.pipeline import STAGES

    distributed = [stage.name for stage in STAGES if stage.together]
    if processes() > 1 and command not in distributed:
        raise UsageError("torchrun", "command", expected=" or ".join(distributed), got=command)
