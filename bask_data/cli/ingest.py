"""`ingest`: a sub-command per format, and the simulator."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from bask_data.cli.console import say, show_outcome, shown_progress
from bask_data.cli.options import Json, Root, add_command, checked_options, names_of, option_of, parameter
from bask_data.cli.working import finish, quoted
from bask_data.formats import FORMATS, Format
from bask_data.sim.options import SimOptions, TaskName

app = typer.Typer(
    no_args_is_help=True, rich_markup_mode=None, help="Read a recording into a dataset; one sub-command per format."
)


def _add_format(format: Format) -> None:
    source = Annotated[
        Path, typer.Argument(help="The recording's folder.", metavar="SOURCE", exists=True, file_okay=False)
    ]
    scene = Annotated[str, typer.Option("--scene", help="Name of the recording in the dataset.", metavar="NAME")]
    as_ = Annotated[
        Literal["scan", "demonstration"], typer.Option("--as", help="A scan of a static scene, or a demonstration.")
    ]
    replace = Annotated[bool, typer.Option("--force", help="Replace a recording of that name.")]
    parameters = [
        parameter("source", source, inspect.Parameter.empty),
        parameter("root", Root, inspect.Parameter.empty),
        parameter("scene", scene, inspect.Parameter.empty),
        parameter("as_", as_, "scan"),
        *[option_of(name, field) for name, field in format.options.model_fields.items()],
        parameter("force", replace, False),
        parameter("json_", Json, False),
    ]

    def body(source: Path, root: Path, scene: str, as_: Any, force: bool, json_: bool, **options: Any) -> None:
        from bask_data.stages.ingest import ingest

        values = checked_options(format.options, options, f"bask-data ingest {format.name}")
        with shown_progress():
            outcomes, assumptions = ingest(
                root, scene, format=format, source=source, options=values, kind=as_, force=force
            )
        for name, text in assumptions.items():
            say(f"  assumed     {name}: {text}")
        for outcome in outcomes:
            show_outcome(outcome)
        finish(f"ingest {format.name}", outcomes, json_, f"bask-data run {quoted(root)}", assumptions=assumptions)

    add_command(app, format.name, format.help, parameters, body)


for _format in FORMATS:
    _add_format(_format)


def _add_simulator() -> None:
    def counted(what: str) -> Any:
        return Annotated[int, typer.Option(min=0, help=f"Number of {what}.")]

    only = Annotated[
        str, typer.Option(help="Only these, whatever the numbers say: lid_scan0,lid_demo3.", metavar="NAMES")
    ]
    fields = SimOptions.model_fields
    task = Annotated[TaskName, typer.Option("--task", help=fields["task"].description)]
    parameters = [
        parameter("root", Root, inspect.Parameter.empty),
        parameter("task", task, inspect.Parameter.empty),
        parameter("scans", counted("scans of the objects, each in another place"), 5),
        parameter("demonstrations", counted("demonstrations of the task"), 14),
        *[option_of(name, field) for name, field in fields.items() if name != "task"],
        parameter("only", only, ""),
        parameter("force", Annotated[bool, typer.Option("--force", help="Replace recordings of those names.")], False),
        parameter("json_", Json, False),
    ]

    def body(root: Path, scans: int, demonstrations: int, only: str, force: bool, json_: bool, **options: Any) -> None:
        from bask_data.stages.simulate import simulate

        values = checked_options(SimOptions, options, "bask-data ingest sim")
        assert isinstance(values, SimOptions)
        with shown_progress():
            outcomes, n_failed = simulate(
                root, values, n_scans=scans, n_demonstrations=demonstrations, only=names_of(only), force=force
            )
        for outcome in outcomes:
            show_outcome(outcome)
        if n_failed:
            say(f"  note: {n_failed} demonstrations failed at the task and were drawn anew")
        following = f"bask-data run {quoted(root)}"
        finish("ingest sim", outcomes, json_, following, failed_demonstrations=n_failed)

    help_ = "Simulate a tabletop task: scans and demonstrations whose truth is known exactly."
    add_command(app, "sim", help_, parameters, body)


_add_simulator()
