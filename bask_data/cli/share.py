"""`export`: files that other programs learn policies from."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from bask_data.cli.console import say, shown_progress
from bask_data.cli.failures import reporting
from bask_data.cli.options import Json, Root, names_of
from bask_data.dataset import Dataset
from bask_data.export import FormatName

app = typer.Typer(rich_markup_mode=None)


@app.command("export")
@reporting
def export_(
    format: Annotated[
        FormatName,
        typer.Argument(help="parquet: tables. lerobot: dataset v3. robomimic: HDF5. diffusion-policy: replay buffer."),
    ],
    root: Root,
    out: Annotated[Path, typer.Argument(help="Folder to write; robomimic: file, ending in .hdf5.", metavar="OUT")],
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
    from bask_data.export import Choice, export

    dataset = Dataset(root)
    choice = Choice(
        variant, names_of(only), names_of(validation), names_of(test), noise=noise, seed=seed, videos=videos, task=task
    )
    with shown_progress():
        done = export(dataset, out, format, choice, force=force)
    for note in done.notes:
        say(f"  note: {note}")
    counts = ", ".join(f"{len(names)} for {split}" for split, names in done.splits.items() if names)
    say(f"made {out}  ({counts}; {done.n_frames} frames; {done.n_bytes / 1e6:.1f} MB)")
    if json_:
        print(json.dumps({"command": "export", **vars(done)}, indent=2))
    say(f"next: {done.opened_with}")
