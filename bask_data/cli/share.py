"""Commands for sharing a dataset: `export` and `dvc`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from bask_data.cli import completion
from bask_data.cli.commands import CommandList
from bask_data.cli.console import print_result, say, shown_progress
from bask_data.cli.options import ConfigFile, Json, Preset, Root, names_of
from bask_data.cli.working import quoted
from bask_data.config import load_config
from bask_data.dataset import Dataset
from bask_data.export import FORMATS
from bask_data.pipeline import STAGES

if TYPE_CHECKING:
    FormatName = str
else:
    FormatName = Literal[tuple(format.name for format in FORMATS)]  # Typer reads the choices from the type.

FORMATS_HELP = " ".join(f"{format.name}: {format.help}." for format in FORMATS)
OUT_HELP = "".join(
    ["Folder to write", *(f"; {format.name}: a {format.suffixes[0]} file" for format in FORMATS if format.is_file), "."]
)

CAMERAS_HELP = "Include images, depth, intrinsics and poses of the cameras, which `ingest` reads back; " + (
    " or ".join(format.name for format in FORMATS if format.ingested) + " only."
)

NAMES = "Which demonstrations"
KEYPOINTS = "Keypoints"


def _demonstrations(help: str) -> Any:
    """An option whose value is names of demonstrations."""
    return typer.Option(help=help, metavar="NAMES", rich_help_panel=NAMES, autocompletion=completion.demonstrations)


TrackVariant = Annotated[
    str,
    typer.Option(
        help="Variant of the keypoints.",
        metavar="NAME",
        rich_help_panel=KEYPOINTS,
        autocompletion=completion.variants_of("keypoints"),
    ),
]
Noise = Annotated[
    float,
    typer.Option(
        help="Standard deviation of noise added to keypoints, in metres; the paper's policies use 0.02.",
        rich_help_panel=KEYPOINTS,
    ),
]

app = CommandList()


@app.command(
    epilog="""
    bask-data export parquet data/demo tables
    bask-data export lerobot data/demo lerobot --videos --test demo3
    """
)
def export(
    format: Annotated[FormatName, typer.Argument(help=FORMATS_HELP, metavar="FORMAT")],
    root: Root,
    out: Annotated[Path, typer.Argument(help=OUT_HELP, metavar="OUT")],
    videos: Annotated[bool, typer.Option("--videos", help="Include the cameras' images.")] = False,
    cameras: Annotated[bool, typer.Option("--cameras", help=CAMERAS_HELP)] = False,
    task: Annotated[
        str, typer.Option(help="Description of the task. [default: that of the source, otherwise the dataset's name]")
    ] = "",
    force: Annotated[bool, typer.Option("--force", help="Replace an existing export.")] = False,
    only: Annotated[str, _demonstrations("Only these demonstrations, separated by commas.")] = "",
    validation: Annotated[str, _demonstrations("Demonstrations to validate on.")] = "",
    test: Annotated[str, _demonstrations("Demonstrations to test on.")] = "",
    variant: TrackVariant = "main",
    noise: Noise = 0.0,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the noise.", rich_help_panel=KEYPOINTS)] = 0,
    json_: Json = False,
) -> None:
    """Write demonstrations and their keypoints in a format for policy learning."""
    from bask_data.export import ExportSettings
    from bask_data.export import export as write_export

    settings = ExportSettings(
        variant,
        names_of(only),
        names_of(validation),
        names_of(test),
        noise=noise,
        seed=seed,
        videos=videos,
        cameras=cameras,
        task=task,
    )
    with shown_progress():
        done = write_export(Dataset(root), out, format, settings, force=force)
    for note in done.notes:
        say(f"  note: {note}")
    print_result("export", [], vars(done), json_)
    counts = ", ".join(f"{len(names)} for {split}" for split, names in done.splits.items() if names)
    say(f"made {out}  ({counts}; {done.n_frames} frames; {done.n_bytes / 1e6:.1f} MB)")
    say(f"next: {done.opened_with}")


@app.command(
    epilog="""
    bask-data dvc data/demo
    bask-data dvc data/demo --check
    """
)
def dvc(
    root: Root,
    check: Annotated[bool, typer.Option("--check", help="Only check whether the files are up to date.")] = False,
    config: ConfigFile = None,
    preset: Preset = None,
    json_: Json = False,
) -> None:
    """Write dvc.yaml and params.yaml, to run the pipeline with `dvc repro`."""
    from bask_data.dvc import compared_files, written_files

    files = (compared_files if check else written_files)(Dataset(root), STAGES, load_config(config, [], STAGES, preset))
    document = {"files": sorted(files.texts), "changed": list(files.changed)}
    print_result("dvc", files.changed if check else [], document, json_)
    if check:
        files.refuse_changed()
        return
    for name in files.changed:
        say(f"made {root / name}")
    say(f"next: dvc repro {quoted(root / 'dvc.yaml')}")
