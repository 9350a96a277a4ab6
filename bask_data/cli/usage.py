"""Errors of the command-line parser in the form of all others: where, expected, got, fix."""

from __future__ import annotations

from pathlib import Path
from typing import Any, get_args, get_origin

import typer
from typer._click.core import Context

from bask_data.errors import UsageError
from bask_data.spelling import suggestion


def from_parser(error: typer.TyperException, context: Context, values: dict[str, Any]) -> UsageError:
    """A parser's error in our form. Typer does not export the classes of these errors; attributes distinguish them.

    Args:
        values: the value given for each parameter, before conversion.
    """
    where = context.command_path
    help_ = f"see `{where} --help`."
    name = getattr(error, "option_name", "")
    parameter = getattr(error, "param", None)
    if hasattr(error, "possibilities"):
        options = [flag for option in context.command.params for flag in (*option.opts, *option.secondary_opts)]
        fix = suggestion(name, options) or help_
        return UsageError(where, "", expected="an option of this command", got=name, fix=fix)
    if name:
        option: Any
        [option] = [each for each in context.command.get_params(context) if name in (*each.opts, *each.secondary_opts)]
        if option.is_flag:
            return UsageError(where, name, expected="no value", got="a value", fix=f"write {name} alone.")
        return UsageError(where, name, expected=expected_of(option), got="none", fix=help_)
    if parameter is None:
        return UsageError(where, "", expected="a valid command line", got=error.format_message(), fix=help_)
    field = shown_name(parameter)
    if hasattr(error, "param_type"):
        return UsageError(where, field, expected=_meaning(parameter), got="none", fix=help_)
    given = values.get(parameter.name, "")
    given = ", ".join(map(str, given)) if isinstance(given, list | tuple) else str(given)
    choices = [str(choice) for choice in parameter.type_descriptor.choices or ()]
    fix = "check the path." if parameter.type_descriptor.is_path else suggestion(given, choices) or help_
    return UsageError(where, field, expected=expected_of(parameter), got=f"'{given}'", fix=fix)


def extra_arguments(extra: list[str], context: Context) -> UsageError:
    """The error for superfluous arguments."""
    arguments = [shown_name(argument) for argument in context.command.params if argument.param_type_name == "argument"]
    expected = f"{' '.join(arguments) or 'no argument'} and nothing more"
    fix = f"see `{context.command_path} --help`; put text with spaces in quotes."
    return UsageError(context.command_path, "", expected=expected, got=" ".join(extra), fix=fix)


def unknown_command(name: str, known: list[str], context: Context) -> UsageError:
    """The error for a command that does not exist."""
    fix = suggestion(name, known) or f"`{context.command_path} --help` lists the commands."
    return UsageError(context.command_path, "", expected="one of its commands", got=name, fix=fix)


def shown_name(parameter: Any) -> str:
    """A parameter as errors name it: an option by its longest flag, an argument by its name in capitals."""
    if parameter.param_type_name == "option":
        return str(max(parameter.opts, key=len))
    return str(parameter.metavar or parameter.name.upper())


def _meaning(parameter: Any) -> str:
    """The meaning of a required parameter: its choices, or the first sentence of its help."""
    if parameter.type_descriptor.choices:
        return expected_of(parameter)
    first = (parameter.help or parameter.name).split(". ")[0].rstrip(".")
    return first[0].lower() + first[1:]


def expected_of(parameter: Any) -> str:
    """The values that a parameter accepts, in words."""
    descriptor = parameter.type_descriptor
    annotation = descriptor.annotation
    if get_origin(annotation) is list:
        [annotation] = get_args(annotation)
    if descriptor.choices:
        return "one of " + ", ".join(map(str, descriptor.choices))
    if annotation in (int, float):
        least = "" if parameter.min is None else f" of at least {parameter.min}"
        most = "" if parameter.max is None else f"{' and' if least else ' of'} at most {parameter.max}"
        return f"a {'whole ' if annotation is int else ''}number{least}{most}"
    if isinstance(annotation, type) and issubclass(annotation, Path):
        kind = "file" if not descriptor.parameter_info.dir_okay else "directory"
        return f"a {kind} that exists" if descriptor.parameter_info.exists else "a path"
    return f"a value, {parameter.metavar}" if parameter.metavar else "a value"
