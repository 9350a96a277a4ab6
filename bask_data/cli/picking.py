"""Picking reference keypoints in a browser: `reference --pick`."""

from __future__ import annotations

import inspect
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from bask_data.artifact import read_manifest
from bask_data.cli.console import say, show_outcome, shown_progress
from bask_data.cli.options import parameter
from bask_data.engine import Outcome, own_parameters, record_requested
from bask_data.errors import UsageError
from bask_data.pipeline import STAGES

if TYPE_CHECKING:
    from bask_data.cli.calls import StageCall

PANEL = "Picking in a browser"


def pick_options() -> list[inspect.Parameter]:
    """The options that only `reference` has, for picking in a browser."""
    flag = typer.Option(
        "--pick",
        help="Pick keypoints on a page in a browser, which shows where each is found in other views.",
        rich_help_panel=PANEL,
    )
    port = typer.Option(
        min=0, max=65535, help="With --pick: port of the page. [default: any free port]", rich_help_panel=PANEL
    )
    browser = typer.Option(
        "--browser/--no-browser",
        help="With --pick: open the page if there is a display.",
        rich_help_panel=PANEL,
    )
    return [
        parameter("pick", Annotated[bool, flag], False),
        parameter("port", Annotated[int | None, port], None),
        parameter("browser", Annotated[bool, browser], True),
    ]


def refuse_without_pick(options: dict[str, Any]) -> None:
    """`UsageError` for an option that needs --pick."""
    if options.get("port") is not None:
        raise UsageError("reference", "--port", expected="--pick as well", got="--port alone", fix="--pick --port N")


def pick(call: StageCall, *, parameters: Path, dry_run: bool, options: dict[str, Any]) -> list[Outcome]:
    """Serve the page until it is closed, and return the outcomes of saving; empty if nothing was saved.

    Args:
        parameters: file in which the picks are stored.
    """
    from bask_data.picker import Picking, pick_keypoints

    if dry_run:
        raise UsageError("reference", "--dry-run", expected="--dry-run without --pick", got="both")

    def opened(url: str) -> None:
        say(f"open {url}  (Ctrl-C to stop; unsaved keypoints are kept)")
        if options["browser"]:
            _open_in_browser(url)

    with shown_progress():
        picking = Picking(
            call.dataset,
            planned=lambda more: call.tasks(more)[0],
            parameters=parameters,
            following=call.following,
            inputs=call.request.variant_inputs,
        )
        try:
            outcomes = pick_keypoints(picking, say=say, opened=opened, port=options["port"] or 0)
        except KeyboardInterrupt:
            say("interrupted: nothing was saved; the picks are kept, and the same command continues with them.")
            raise typer.Exit(130) from None
    if outcomes:
        _record(call, outcomes[-1])
    for outcome in outcomes:
        show_outcome(outcome)
    if not outcomes:
        say("nothing was saved; the same command continues with the picks.")
    return outcomes


def _record(call: StageCall, saved: Outcome) -> None:
    """Record the request with the picks, which may be in another file than the dataset's own params.yaml."""
    params = read_manifest(Path(saved.path)).params
    request = replace(call.request, options={**call.request.options, "picks": params["picks"], "auto": params["auto"]})
    # Read after saving, which may have written the picks to it.
    record_requested(call.dataset, call.stage, request, own_parameters(call.dataset.root, STAGES))


def _open_in_browser(url: str) -> None:
    import webbrowser

    from bask_data.view.windows import has_display

    if has_display():
        webbrowser.open(url)
