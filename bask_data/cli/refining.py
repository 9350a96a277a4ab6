"""`refine`: errors of poses found from depth, and recordings without them."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from bask_data.cli import completion
from bask_data.cli.commands import CommandList
from bask_data.cli.console import say, show_outcome, shown_progress
from bask_data.cli.options import Json, Root, add_command, checked_options, options_of, parameter
from bask_data.cli.working import finish, quoted
from bask_data.errors import UsageError
from bask_data.sources.refine import Refined, RefineParams

if TYPE_CHECKING:
    from bask_data.dataset import Dataset

SUFFIX = "-refined"
"""What the names of recordings with corrected poses end with by default."""

app = CommandList()

Recordings = Annotated[
    list[str] | None,
    typer.Argument(
        help="Scans to refine. [default: all]", metavar="[RECORDING...]", autocompletion=completion.recordings
    ),
]
As = Annotated[
    str,
    typer.Option(
        "--as", help=f"Name of the recording with corrected poses. [default: its name + {SUFFIX}]", metavar="NAME"
    ),
]
Apply = Annotated[
    str,
    typer.Option(
        help="Correct the recordings by the hand-eye error found in this scan: demonstrations of the same rig.",
        metavar="SCAN",
        autocompletion=completion.scenes,
    ),
]
Replace = Annotated[bool, typer.Option("--force", help="Replace existing recordings, and refine again.")]

HELP = """Look for errors in a scan's poses, and write a scan without them beside it.

    Depth of frames that overlap tells two kinds of error: one rigid error of all poses, as of a hand-eye calibration,
    and poses that drift. A correction is fitted on some pairs of frames and judged by others. If these meet clearly
    better, a scan with corrected poses is written; the given one stays as it is.
    """


def _body(
    root: Path,
    recordings: list[str] | None,
    as_: str,
    apply: str,
    force: bool,
    json_: bool,
    **options: Any,
) -> None:
    from bask_data.dataset import Dataset
    from bask_data.sources.refine import apply as applied
    from bask_data.sources.refine import refine

    params = checked_options(RefineParams, options, "bask-data refine")
    assert isinstance(params, RefineParams)
    dataset = Dataset(root)
    dataset.recover()
    names = _names(dataset, recordings or [], apply)
    if as_ and len(names) != 1:
        raise UsageError("refine", "--as", expected="one recording", got=str(len(names)), fix="name it after ROOT.")
    results = []
    with shown_progress():
        for name in names:
            target = as_ or name + SUFFIX
            if apply:
                result = applied(dataset, apply, name, target, force=force)
            else:
                result = refine(dataset, name, target, params, force=force)
            _show(result)
            results.append(result)
    outcomes = [outcome for result in results for outcome in result.outcomes]
    findings = [finding.as_json() for result in results for finding in result.findings]
    written = [result.written for result in results if result.written]
    following = f"bask-data run {quoted(root)} --only {','.join(written)}" if written else ""
    finish("refine", outcomes, json_, following, findings=findings, written=written)


def _names(dataset: Dataset, given: list[str], apply: str) -> list[str]:
    """The recordings to work on: those named, or all scans that were not made by `refine` themselves."""
    if apply:
        dataset.select([apply], "scene", option="--apply")
        if not given:
            raise UsageError("refine", "RECORDING", expected="recordings to apply it to", got="none")
        return dataset.select(given, option="RECORDING")
    if given:
        return dataset.select(given, "scene", option="SCAN")
    dataset.select([], "scene")
    return [name for name in dataset.items("scene") if dataset.file.scenes[name].format != "refine"]


def _show(result: Refined) -> None:
    for outcome in result.outcomes:
        show_outcome(outcome)
    for finding in result.findings:
        say(f"  {finding.code:<18}  {finding.place}: {finding.evidence}")
        if finding.fix:
            say(f"  {'':<18}  fix: {finding.fix}")


add_command(
    app,
    "refine",
    [
        parameter("root", Root, inspect.Parameter.empty, inspect.Parameter.POSITIONAL_OR_KEYWORD),
        parameter("recordings", Recordings, None, inspect.Parameter.POSITIONAL_OR_KEYWORD),
        parameter("as_", As, ""),
        *options_of("refine", RefineParams),
        parameter("apply", Apply, ""),
        parameter("force", Replace, False),
        parameter("json_", Json, False),
    ],
    _body,
    help=HELP,
    epilog="""
    bask-data refine data/demo table
    bask-data refine data/demo table --as table2 --model hand-eye
    bask-data refine data/demo demo1 demo2 --apply table
    """,
)
