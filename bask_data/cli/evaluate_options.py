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
        "Networks to track with, by commas: all filters with the first, single frames with the others.",
        completed=NETWORKS,
    ),
]
Scenes = Annotated[
    str, _names("Scenes to measure on. [default: what was held out of training]", completed=completion.scenes)
]
Demonstrations = Annotated[
    str, _names("Demonstrations to track in. [default: all with truth]", completed=completion.demonstrations)
]
Against = Annotated[
    list[str],
    _names(
        "A further dataset whose truth names the same objects, to look for the keypoints in: other instances, other "
        "surroundings. May be repeated.",
        WHAT,
        "NAME=ROOT",
    ),
]
Objects = Annotated[str, _names("Objects to put keypoints on. [default: all of a demonstration]", WHAT)]
Cameras = Annotated[str, _names("Cameras to track with, `wrist` in the paper. [default: all]", WHAT)]
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
        "Recordings to choose these points in, the first with the objects; a demonstration in the paper. "
        "[default: scans that networks learn from]",
        WHAT,
        completed=completion.recordings,
    ),
]
SoughtKeypoints = Annotated[
    int,
    typer.Option(
        min=0, help="Keypoints picked in a view trained on, to look for in others; 0 is none.", rich_help_panel=WHAT
    ),
]
TrackedKeypoints = Annotated[
    int, typer.Option(min=1, help="Number of points, shared among the objects.", rich_help_panel=WHAT)
]
Sweep = Annotated[
    bool,
    typer.Option(
        "--sweep/--no-sweep", help="Zoom and turn some of the views by given amounts, too.", rich_help_panel=WHAT
    ),
]
Pairs = Annotated[int, typer.Option(min=1, help="Most pairs of frames, of each scene.", rich_help_panel=HOW)]
Alpha = Annotated[
    float,
    typer.Option(min=0, help="Temperature of the heat maps whose truthfulness is measured.", rich_help_panel=HOW),
]
Seed = Annotated[int, typer.Option(min=0, help="Seed of what is chosen at random.", rich_help_panel=HOW)]
FilterSettings = Annotated[
    Literal["default", "paper", "code"],
    typer.Option(help="Settings of the filters: our own, the paper's, or its authors' code's.", rich_help_panel=HOW),
]
Pictures = Annotated[Path | None, typer.Option(help="Draw the figures into this folder, as PNG.", metavar="DIR")]
