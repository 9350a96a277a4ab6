"""Options of `evaluate`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from bask_data.cli import completion

WHAT = "What is measured"
HOW = "How it is measured"


def _names(help: str, panel: str | None = None, metavar: str = "NAMES", completed: Any = None) -> Any:
    """An option that takes names, separated by commas."""
    return typer.Option(help=help, metavar=metavar, rich_help_panel=panel, autocompletion=completed)


NETWORKS = completion.variants_of("descriptor")
Networks = Annotated[str, _names("Networks to compare, separated by commas.", completed=NETWORKS)]
Trackers = Annotated[
    str,
    _names(
        "Networks to track with, separated by commas: the first with all filters, the others without filtering.",
        completed=NETWORKS,
    ),
]
Scenes = Annotated[
    str, _names("Scenes to measure on. [default: those held out from training]", completed=completion.scenes)
]
Demonstrations = Annotated[
    str, _names("Demonstrations to track in. [default: all with ground truth]", completed=completion.demonstrations)
]
Against = Annotated[
    list[str],
    _names(
        "A further dataset to find the keypoints in, whose ground truth names the same objects: other instances or "
        "other backgrounds. May be repeated.",
        WHAT,
        "NAME=ROOT",
    ),
]
Objects = Annotated[str, _names("Objects to place keypoints on. [default: all of a demonstration]", WHAT)]
Cameras = Annotated[str, _names("Cameras to track with; the paper uses `wrist`. [default: all]", WHAT)]
Reference = Annotated[
    str,
    _names(
        "Reference keypoints to track. [default: points spread over the objects]",
        WHAT,
        "VARIANT",
        completion.variants_of("reference"),
    ),
]
PickIn = Annotated[
    str,
    _names(
        "Recordings to pick these points in; the first that shows the objects is used. The paper uses a demonstration. "
        "[default: training scans]",
        WHAT,
        completed=completion.recordings,
    ),
]
SoughtKeypoints = Annotated[
    int,
    typer.Option(
        min=0, help="Keypoints to pick in a training view and find in others; 0 for none.", rich_help_panel=WHAT
    ),
]
TrackedKeypoints = Annotated[
    int, typer.Option(min=1, help="Number of keypoints, shared among the objects.", rich_help_panel=WHAT)
]
Sweep = Annotated[
    bool,
    typer.Option(
        "--sweep/--no-sweep", help="Also scale and rotate some of the views by fixed amounts.", rich_help_panel=WHAT
    ),
]
Pairs = Annotated[int, typer.Option(min=1, help="Largest number of pairs of frames per scene.", rich_help_panel=HOW)]
Alpha = Annotated[
    float,
    typer.Option(min=0, help="Temperature of the heat maps whose calibration is measured.", rich_help_panel=HOW),
]
Seed = Annotated[int, typer.Option(min=0, help="Random seed.", rich_help_panel=HOW)]
Stride = Annotated[
    int,
    typer.Option(
        min=1,
        help="Track in every N-th frame only, as with a slower camera; saves time.",
        metavar="N",
        rich_help_panel=HOW,
    ),
]
FilterSettings = Annotated[
    Literal["default", "paper", "code"],
    typer.Option(
        help="Settings of the filters: bask-data's own, the paper's, or those of its code.", rich_help_panel=HOW
    ),
]
Pictures = Annotated[Path | None, typer.Option(help="Write the figures to this folder, as PNG.", metavar="DIR")]
