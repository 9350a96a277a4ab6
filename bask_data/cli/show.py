"""Commands for looking at a dataset: `report` and `view`."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any

import typer

from bask_data.cli import completion
from bask_data.cli.commands import CommandList
from bask_data.cli.console import print_result, say, shown_progress
from bask_data.cli.options import Json, Only, Root, names_of
from bask_data.cli.panels import OUTPUT
from bask_data.cli.working import quoted
from bask_data.dataset import Dataset
from bask_data.errors import UsageError

if TYPE_CHECKING:
    from bask_data.view.choice import Choice

SHOWN = "What is shown"
WHERE = "Where it is shown"

Save = Annotated[
    Path | None,
    typer.Option(help="Write a Rerun recording to this file, ending in .rrd.", metavar="FILE", rich_help_panel=WHERE),
]
Web = Annotated[
    bool, typer.Option("--web", help="Show it in a browser; needs no display on this machine.", rich_help_panel=WHERE)
]
Port = Annotated[
    int | None,
    typer.Option(
        help="With --web: port of the viewer, which also uses the next port. [default: 9090]",
        min=1,
        max=65534,
        rich_help_panel=WHERE,
    ),
]
Video = Annotated[
    Path | None,
    typer.Option(
        help="Instead, write an mp4 of each demonstration with its keypoints to this folder.",
        metavar="DIR",
        rich_help_panel=WHERE,
    ),
]
Every = Annotated[int, typer.Option(min=1, help="Show every N-th frame.", rich_help_panel=SHOWN)]
Pairs = Annotated[
    int,
    typer.Option(min=0, help="Largest number of pairs of views per scene to show matches of.", rich_help_panel=SHOWN),
]
ShownVariant = Annotated[
    str,
    typer.Option(
        help="Variant of network, heat maps and keypoints.",
        metavar="NAME",
        rich_help_panel=SHOWN,
        autocompletion=completion.variants_of("descriptor", "reference", "keypoints"),
    ),
]
Beliefs = Annotated[
    bool,
    typer.Option(
        "--beliefs",
        help="Repeat the tracking to show the filter's particles or maps in each frame.",
        rich_help_panel=SHOWN,
    ),
]
Replace = Annotated[bool, typer.Option("--force", help="Replace existing files.", rich_help_panel=OUTPUT)]

app = CommandList()


@app.command(
    epilog="""
    bask-data report data/demo
    bask-data report data/demo --out demo.html
    """
)
def report(
    root: Root,
    out: Annotated[Path | None, typer.Option(help="File to write. [default: ROOT/report.html]", metavar="FILE")] = None,
    json_: Json = False,
) -> None:
    """Write an HTML page with pictures and quality figures of everything in a dataset."""
    from bask_data.report import measure, summarise, write_report

    dataset = Dataset(root)
    with shown_progress():
        measured = measure(dataset)
        file = write_report(dataset, out or root / "report.html", measured)
        document = {"file": str(file), **summarise(dataset, measured)} if json_ else {}
    print_result("report", [], document, json_)
    say(f"made {file}  (open it in a browser)")


@app.command(
    epilog="""
    bask-data view data/demo --only table
    bask-data view data/demo --web
    bask-data view data/demo --save demo.rrd --every 5
    bask-data view data/demo --video videos
    """
)
def view(
    root: Root,
    only: Only = "",
    variant: ShownVariant = "main",
    every: Every = 1,
    pairs: Pairs = 40,
    beliefs: Beliefs = False,
    save: Save = None,
    web: Web = False,
    port: Port = None,
    video: Video = None,
    force: Replace = False,
    json_: Json = False,
) -> None:
    """Show scenes and demonstrations in the Rerun viewer, or save them as a file.

    Opens a window unless --save, --web or --video is given.
    """
    from bask_data.view.choice import Choice

    dataset = Dataset(root)
    choice = Choice(dataset.select(names_of(only)), every, pairs, variant, beliefs)
    _refuse_unknown_variant(dataset, variant)
    if video is not None:
        _write_videos(dataset, video, choice, force, json_)
    else:
        _refuse_without_window(save, web, port)
        _open_viewer(dataset, choice, save, force, json_, (port or 9090) if web else None)


def _refuse_unknown_variant(dataset: Dataset, variant: str) -> None:
    from bask_data.kinds import DescriptorNet, KeypointTrack, ReferenceKeypoints

    kinds = DescriptorNet, ReferenceKeypoints, KeypointTrack
    variants = dict.fromkeys(name for kind in kinds for name in dataset.variants(kind))
    if variant not in variants:
        raise UsageError(dataset.root, "--variant", expected=f"one of {', '.join(variants)}", got=variant)


def _refuse_without_window(save: Path | None, web: bool, port: int | None) -> None:
    from bask_data.view.windows import has_display

    if port is not None and not web:
        raise UsageError("view", "--port", expected="--web as well", got="--port alone", fix="--web --port N")
    if not (save or web or has_display()):
        fix = "use --web, or --save FILE.rrd."
        raise UsageError("view", "", expected="a display to open a window on", got="none", fix=fix)


def _open_viewer(
    dataset: Dataset, choice: Choice, save: Path | None, force: bool, as_json: bool, port: int | None
) -> None:
    """Write the Rerun recording, permanently or to a temporary file, and show it if wanted."""
    from bask_data.view.saving import save_recording
    from bask_data.view.windows import serve, show

    with TemporaryDirectory(prefix="bask-data-") as folder:
        file = save or Path(folder) / f"{dataset.root.resolve().name}.rrd"
        with shown_progress():
            shown = save_recording(dataset, file, choice, force=force)
        for name, item in shown.items():
            for line in _shown_lines(name, item):
                say(line)
        saved = {"file": str(save) if save else None, "bytes": file.stat().st_size}
        print_result("view", [], {**saved, "items": {name: vars(item) for name, item in shown.items()}}, as_json)
        if save:
            say(f"made {file}  ({file.stat().st_size / 1e6:.1f} MB; open it with: rerun {quoted(file)})")
        if port is not None:
            serve(file, port, say=lambda url: say(f"open {url}  (Ctrl-C to stop)"))
        elif not save:
            show(file)


def _write_videos(dataset: Dataset, folder: Path, choice: Choice, force: bool, as_json: bool) -> None:
    from bask_data.view.video import write_videos

    with shown_progress():
        files = write_videos(dataset, folder, choice.items, variant=choice.variant, every=choice.every, force=force)
    for file in files.values():
        say(f"made {file}")
    print_result("view", [], {"videos": {name: str(file) for name, file in files.items()}}, as_json)


def _shown_lines(name: str, shown: Any) -> Iterator[str]:
    frames = ", ".join(f"{n} frames of {camera}" for camera, n in shown.frames.items())
    layers = ", ".join(layer for layer in shown.layers if layer != "frames")
    yield f"  shown       {name}: {'; '.join(part for part in (frames, layers) if part) or 'nothing'}"
    if shown.missing:
        yield f"  missing     {name}: {', '.join(shown.missing)}"
