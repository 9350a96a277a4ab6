"""Options shared by several commands, and options generated from the fields of a model."""

from __future__ import annotations

import inspect
import types
import typing
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args, get_origin

import typer

from bask_data.cli import completion
from bask_data.cli.commands import CommandList
from bask_data.cli.panels import ELSEWHERE, OUTPUT, WORKERS, panels_of
from bask_data.errors import UsageError
from bask_data.params import Params, first_fault
from bask_data.presets import PresetName

Root = Annotated[Path, typer.Argument(help="The dataset's directory.", metavar="ROOT")]
Json = Annotated[bool, typer.Option("--json", help="Print the result as JSON on stdout.", rich_help_panel=OUTPUT)]


def _only(what: str, completed: completion.Completer) -> Any:
    help = f"Only these {what}, separated by commas."
    return Annotated[str, typer.Option(help=help, metavar="NAMES", autocompletion=completed)]


if TYPE_CHECKING:
    Only = str
else:
    Only = _only("scenes or demonstrations", completion.recordings)
ONLY = {
    "scene": _only("scenes", completion.scenes),
    "demonstration": _only("demonstrations", completion.demonstrations),
}
"""`--only` by the scope of the artifacts that a stage makes."""

Jobs = Annotated[
    int,
    typer.Option(
        min=1, help="Number of items to process in parallel, each in its own process.", rich_help_panel=WORKERS
    ),
]
Cluster = Annotated[
    str,
    typer.Option(help="Dask scheduler to run on instead: tcp://host:8786.", metavar="ADDRESS", rich_help_panel=WORKERS),
]
Force = Annotated[bool, typer.Option("--force", help="Make artifacts again even if they are up to date.")]
ConfigFile = Annotated[
    Path | None,
    typer.Option(
        "--config",
        help="YAML with a section per stage, or `stage@name` for one item or variant. [default: ROOT/params.yaml]",
        metavar="FILE",
        rich_help_panel=ELSEWHERE,
    ),
]
Preset = Annotated[
    PresetName | None,
    typer.Option(
        "--preset",
        help="How to train and track: tabletop is the default, bask follows the paper, bask-code its code, florence "
        "the original Dense Object Nets. Overrides the file.",
        rich_help_panel=ELSEWHERE,
    ),
]
Set = Annotated[
    list[str],
    typer.Option(
        "--set",
        help="Set one parameter: stage.field=value. May be repeated.",
        metavar="STAGE.FIELD=VALUE",
        autocompletion=completion.assignments,
        rich_help_panel=ELSEWHERE,
    ),
]
Defaults = Annotated[
    bool,
    typer.Option(
        "--defaults",
        help="Ignore the parameters recorded with the dataset: those not given here have their defaults.",
        rich_help_panel=ELSEWHERE,
    ),
]
All = Annotated[bool, typer.Option("--all", help="List every artifact, not only the first few of each stage.")]
DryRun = Annotated[bool, typer.Option("--dry-run", help="Show what would be made, and why, without making it.")]


def parameter(
    name: str, annotation: Any, default: Any, kind: Any = inspect.Parameter.KEYWORD_ONLY
) -> inspect.Parameter:
    """One parameter of a generated signature."""
    return inspect.Parameter(name, kind, annotation=annotation, default=default)


def options_of(command: str, model: type[Params], without: tuple[str, ...] = ()) -> list[inspect.Parameter]:
    """The fields of a model as options, under the command's headings and in their order."""
    fields = {name: field for name, field in model.model_fields.items() if name not in without}
    panels = panels_of(command, list(fields))
    return [_option(name, fields[name], panel) for name, panel in panels.items() if name in fields]


def _option(name: str, field: Any, panel: str) -> inspect.Parameter:
    """One field of a model as an option. An unset option is None and leaves the value to the configuration."""
    flag = "--" + name.replace("_", "-")
    annotation = _plain_type(field.annotation)
    default = field.get_default(call_default_factory=True)
    shown = "" if default is None or default == "" or default is ... else _as_text(default)
    flags = [f"{flag}/--no-{flag[2:]}"] if annotation is bool else [flag]
    text = (field.description or "") + (f" [default: {shown}]" if shown else "")
    option = typer.Option(*flags, help=text, show_default=False, rich_help_panel=panel, metavar=_metavar(field))
    return parameter(name, Annotated[annotation | None, option], None)


def _metavar(field: Any) -> str | None:
    """Placeholder for the value if it is a list or a file; None leaves it to the type."""
    if isinstance(field.json_schema_extra, dict) and field.json_schema_extra.get("file"):
        return "FILE"
    return "A,B,..." if _is_sequence(field.annotation) else None


def _plain_type(annotation: Any) -> Any:
    """The type of an option: number, flag, choice, or otherwise text, which the model checks."""
    if get_origin(annotation) is Literal:
        return annotation
    if get_origin(annotation) in (typing.Union, types.UnionType):
        inner = [part for part in get_args(annotation) if part is not type(None)]
        return _plain_type(inner[0]) if len(inner) == 1 else str
    return annotation if annotation in (bool, int, float) else str


def _as_text(value: Any) -> str:
    if isinstance(value, tuple | list):
        return ",".join(map(str, value))
    if isinstance(value, bool):
        return "yes" if value else "no"
    return str(value)


def given_options(model: type[Params], options: dict[str, Any]) -> dict[str, Any]:
    """The options that were set, with lists split at commas."""
    given = {name: value for name, value in options.items() if name in model.model_fields and value is not None}
    for name, value in given.items():
        if isinstance(value, str) and _is_sequence(model.model_fields[name].annotation):
            given[name] = names_of(value)
    return given


def _is_sequence(annotation: Any) -> bool:
    if get_origin(annotation) in (tuple, list):
        return True
    return any(_is_sequence(part) for part in get_args(annotation))


def add_command(
    target: CommandList, name: str, parameters: list[inspect.Parameter], body: Callable[..., None], **texts: Any
) -> None:
    """Add a command with a generated signature: Typer reads options only from signatures.

    Args:
        texts: `help`, and `epilog` with examples.
    """

    def command(**arguments: Any) -> None:
        body(**arguments)

    command.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    command.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    target.command(name, **texts)(command)


def checked_options(model: type[Params], options: dict[str, Any], where: str) -> Params:
    """The model with the options that were set; `UsageError` if it refuses one, naming the option."""
    from pydantic import ValidationError

    try:
        return model.model_validate(given_options(model, options))
    except ValidationError as error:
        field, expected, came = first_fault(error)
        option = "--" + field.split(".")[0].replace("_", "-")
        raise UsageError(where, option, expected=expected, got=came, fix=f"see `{where} --help`.") from error


def names_of(text: str) -> list[str]:
    """The names in a comma-separated list."""
    return [name.strip() for name in text.split(",") if name.strip()]
