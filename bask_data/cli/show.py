"""Commands to look with: `report` and `view`."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from bask_data.cli.console import say, shown_progress
from bask_data.cli.failures import reporting
from bask_data.cli.options import Json, Only, Root
from bask_data.cli.working import chosen_recordings, quoted
from bask_data.dataset import Dataset
from bask_data.errors import UsageError

app = typer.Typer(rich_markup_mode=None)


@app.command()
@reporting
def report(
    root: Root,
    out: Annotated[Path | None, typer.Option(help="File to write. [default: ROOT/report.html]", metavar="FILE")] = None,
    json_: Json = False,
) -> None:
    """Write one HTML page with pictures of everything the dataset holds, and how good it is."""
    from bask_data.report import measure, summarise, write_report

    dataset = Dataset(root)
    with shown_progress():
        measured = measure(dataset)
        file = write_report(dataset, out or root / "report.html", measured)
        if json_:
            print(json.dumps({"command": "report", "file": str(file), **summarise(dataset, measured)}, indent=2))
    say(f"made {file}  (open it in a browser)")


@app.command()
@reporting
def view(
    root: Root,
    only: Only = "",
    save: Annotated[
        Path | None, typer.Option(help="Write the recording to this file, ending in .rrd.", metavar="FILE")
    ] = None,
    web: Annotated[bool, typer.Option("--web", help="Show it in a browser; needs no display here.")] = False,
    port: Annotated[
        int | None,
        typer.Option(help="With --web: of the viewer; the next one is taken too. [default: 9090]", min=1, max=65534),
    ] = None,
    every: Annotated[int, typer.Option(min=1, help="Show each so many-th frame.")] = 1,
    pairs: Annotated[int, typer.Option(min=0, help="Most pairs of views whose matches are shown, a scene.")] = 40,
    variant: Annotated[str, typer.Option(help="Of network, heat maps and keypoints.", metavar="NAME")] = "main",
    beliefs: Annotated[
        bool, typer.Option("--beliefs", help="Track again, to show the filter's particles or maps in each frame.")
    ] = False,
    video: Annotated[
        Path | None,
        typer.Option(
            help="Instead: keypoints over frames, an mp4 of each demonstration in this folder.", metavar="DIR"
        ),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace files.")] = False,
    json_: Json = False,
) -> None:
    """Walk through scenes and demonstrations in the Rerun viewer, or save what it shows."""
    from tempfile import TemporaryDirectory

    from bask_data.kinds import DescriptorNet, KeypointTrack, ReferenceKeypoints
    from bask_data.view.choice import Choice
    from bask_data.view.saving import save_recording
    from bask_data.view.windows import has_display, serve, show

    dataset = Dataset(root)
    items = chosen_recordings(dataset, only)
    kinds = DescriptorNet, ReferenceKeypoints, KeypointTrack
    variants = dict.fromkeys(name for kind in kinds for name in dataset.variants(kind))
    if variant not in variants:
        raise UsageError(root, "--variant", expected=f"one of {', '.join(variants)}", got=variant)
    if video is not None:
        _write_videos(dataset, video, items, variant, every, force, json_)
        return
    if port is not None and not web:
        raise UsageError("view", "--port", expected="to come with --web", got="it alone", fix="--web --port N")
    if not (save or web or has_display()):
        raise UsageError(
            "view", "", expected="a display to open a window on", got="none", fix="use --web, or --save FILE.rrd."
        )
    with TemporaryDirectory(prefix="bask-data-") as folder:
        file = save or Path(folder) / f"{root.resolve().name}.rrd"
        with shown_progress():
            shown = save_recording(dataset, file, Choice(items, every, pairs, variant, beliefs), force=force)
        for name, one in shown.items():
            _show_shown(name, one)
        if json_:
            found = {name: vars(one) for name, one in shown.items()}
            saved = {"file": str(save) if save else None, "bytes": file.stat().st_size}
            print(json.dumps({"command": "view", **saved, "items": found}, indent=2), flush=True)
        if save:
            say(f"made {file}  ({file.stat().st_size / 1e6:.1f} MB; open it with: rerun {quoted(file)})")
        if web:
            serve(file, port or 9090, say=lambda url: say(f"open {url}  (Ctrl-C ends it)"))
        elif not save:
            show(file)


def _write_videos(
    dataset: Dataset, folder: Path, items: Sequence[str], variant: str, every: int, force: bool, json_: bool
) -> None:
    from bask_data.view.video import write_videos

    with shown_progress():
        files = write_videos(dataset, folder, items, variant=variant, every=every, force=force)
    for file in files.values():
        say(f"made {file}")
    if json_:
        print(json.dumps({"command": "view", "videos": {name: str(file) for name, file in files.items()}}, indent=2))


def _show_shown(name: str, one: Any) -> None:
    frames = ", ".join(f"{n} frames of {camera}" for camera, n in one.frames.items())
    layers = ", ".join(layer for layer in one.layers if layer != "frames")
    say(f"  shown       {name}: {'; '.join(part for part in (frames, layers) if part) or 'nothing'}")
    if one.missing:
        say(f"  not there   {name}: {', '.join(one.missing)}")
