"""`export`: files that other programs learn policies from."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from bask_data.cli.console import say, shown_progress
from bask_data.cli.failures import reporting
from bask_data.cli.options import Json, Root, names_of
from bask_data.dataset import Dataset
from bask_data.export import FORMATS

if TYPE_CHECKING:
    FormatName = str
else:
    FormatName = Literal[tuple(format.name for format in FORMATS)]  # Typer reads the choices off the type.

FORMATS_HELP = " ".join(f"{format.name}: {format.help}." for format in FORMATS)
OUT_HELP = "".join(
    ["Folder to write", *(f"; {one.name}: file, ending in {one.suffixes[0]}" for one in FORMATS if one.is_file), "."]
)

app = typer.Typer(rich_markup_mode=None)


@app.command("export")
@reporting
def export_(
    format: Annotated[FormatName, typer.Argument(help=FORMATS_HELP)],
    root: Root,
    out: Annotated[Path, typer.Argument(help=OUT_HELP, metavar="OUT")],
    variant: Annotated[str, typer.Option(help="Of the keypoints.", metavar="NAME")] = "main",
    noise: Annotated[
        float, typer.Option(help="Standard deviation of noise added to keypoints, metres; the paper's policies: 0.02.")
    ] = 0.0,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the noise.")] = 0,
    videos: Annotated[bool, typer.Option("--videos", help="Take the cameras' images along.")] = False,
    only: Annotated[str, typer.Option(help="Only these demonstrations, separated by commas.", metavar="NAMES")] = "",
    validation: Annotated[str, typer.Option(help="Demonstrations to validate on.", metavar="NAMES")] = "",
    test: Annotated[str, typer.Option(help="Demonstrations kept for the test.", metavar="NAMES")] = "",
    task: Annotated[
        str, typer.Option(help="What is done, in words. [default: as the source says, or else the dataset's name]")
    ] = "",
    force: Annotated[bool, typer.Option("--force", help="Replace an export.")] = False,
    json_: Json = False,
) -> None:
    """Write demonstrations with their keypoints as the files that policies are learned from."""
    from bask_data.export import ExportSettings, export

    dataset = Dataset(root)
    settings = ExportSettings(
        variant, names_of(only), names_of(validation), names_of(test), noise=noise, seed=seed, videos=videos, task=task
    )
    with shown_progress():
        done = export(dataset, out, format, settings, force=force)
    for note in done.notes:
        say(f"  note: {note}")
    counts = ", ".join(f"{len(names)} for {split}" for split, names in done.splits.items() if names)
    say(f"made {out}  ({counts}; {done.n_frames} frames; {done.n_bytes / 1e6:.1f} MB)")
    if json_:
        print(json.dumps({"command": "export", **vars(done)}, indent=2))
    say(f"next: {done.opened_with}")
