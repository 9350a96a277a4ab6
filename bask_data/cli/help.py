"""The help of a command: description, options under headings, and examples, in the terminal's width."""

from __future__ import annotations

import inspect
import os
import shutil
import sys
import textwrap
from collections.abc import Sequence
from typing import Any, get_args, get_origin

import typer
from typer._click.core import Context

MOST_WIDTH = 120
"""Characters; longer lines are hard to read."""

OPTIONS = "Options"
"""Heading of options without a panel."""

_MOST_FLAG = 30
"""Longest flags, in characters, with help on the same line; the help of longer ones starts on the next."""

_METAVARS = {int: "N", float: "X", str: "TEXT"}


def rendered(command: Any, context: Context, commands: Sequence[tuple[str, str, str]] = ()) -> str:
    """The help of a command, or of a group, with (panel, name, summary) of its commands."""
    width = min(shutil.get_terminal_size().columns, MOST_WIDTH)
    arguments = [_flags(parameter) for parameter in command.params if parameter.param_type_name == "argument"]
    usage = " ".join([context.command_path, "[OPTIONS]", *(["COMMAND ..."] if commands else arguments)])
    blocks = [_wrapped(f"{_heading('Usage:')} {usage}", width, "       ")]
    blocks += _paragraphs(command.help or "", width)
    sections: dict[str, list[tuple[str, str]]] = {}
    for panel, name, summary in commands:
        sections.setdefault(panel, []).append((name, summary))
    for parameter in command.get_params(context):
        if not parameter.hidden:
            # `--help`, which every command has, comes last.
            panel = (list(sections) or [OPTIONS])[-1] if parameter.name == "help" else _panel(parameter)
            if commands:
                panel = OPTIONS
            sections.setdefault(panel, []).append((_flags(parameter), _help(parameter)))
    blocks += [f"{_heading(title + ':')}\n{_columns(rows, width)}" for title, rows in sections.items()]
    if command.epilog:
        lines = inspect.cleandoc(command.epilog).splitlines()
        blocks.append("\n".join([_heading("Examples:"), *(f"  {line}".rstrip() for line in lines)]))
    return "\n\n".join(blocks) + "\n"


def _heading(text: str) -> str:
    """Bold, on a terminal that shows it, unless NO_COLOR is set."""
    wanted = sys.stdout.isatty() and "NO_COLOR" not in os.environ and os.environ.get("TERM") != "dumb"
    return typer.style(text, bold=True) if wanted else text


def _paragraphs(text: str, width: int) -> list[str]:
    """Paragraphs, filled to the width; indented ones are kept as they are."""
    paragraphs = []
    for paragraph in inspect.cleandoc(text).split("\n\n"):
        is_indented = any(line.startswith(" ") for line in paragraph.splitlines())
        paragraphs.append(paragraph if is_indented else _wrapped(" ".join(paragraph.split()), width))
    return [paragraph for paragraph in paragraphs if paragraph]


def _panel(parameter: Any) -> str:
    if parameter.param_type_name == "argument":
        return "Arguments"
    return parameter.rich_help_panel or OPTIONS


def _flags(parameter: Any) -> str:
    if parameter.param_type_name == "argument":
        return str(parameter.metavar or parameter.name.upper())
    names = ", ".join(sorted(parameter.opts, key=len))
    if parameter.secondary_opts:
        names += " / " + ", ".join(parameter.secondary_opts)
    return names if parameter.is_flag else f"{names} {_metavar(parameter)}"


def _metavar(parameter: Any) -> str:
    """Placeholder for the value of an option."""
    if parameter.metavar:
        return str(parameter.metavar)
    descriptor = parameter.type_descriptor
    if descriptor.choices:
        return "|".join(map(str, descriptor.choices))
    annotation = descriptor.annotation
    if get_origin(annotation) is list:
        [annotation] = get_args(annotation)
    return _METAVARS.get(annotation, "PATH")


def _help(parameter: Any) -> str:
    text = parameter.help or ""
    choices = parameter.type_descriptor.choices
    notes = []
    if parameter.param_type_name == "argument" and choices:
        notes.append("one of " + ", ".join(map(str, choices)))
    if parameter.param_type_name == "option" and parameter.required:
        notes.append("required")
    default = parameter.default
    if parameter.show_default and default not in (None, "", (), []) and default is not False:
        notes.append(f"default: {default}")
    return f"{text} [{'; '.join(notes)}]".strip() if notes else text


def _columns(rows: Sequence[tuple[str, str]], width: int) -> str:
    """Two columns: names, and their help."""
    indent = 4 + max([len(name) for name, _ in rows if len(name) <= _MOST_FLAG], default=_MOST_FLAG)
    lines = []
    for name, text in rows:
        filled = textwrap.wrap(text, max(width - indent, 20), break_long_words=False, break_on_hyphens=False)
        beside = len(name) <= indent - 4
        lines.append(f"  {name}".ljust(indent) + (filled.pop(0) if beside and filled else ""))
        lines += [" " * indent + line for line in filled]
    return "\n".join(line.rstrip() for line in lines)


def _wrapped(text: str, width: int, indent: str = "") -> str:
    return textwrap.fill(text, width, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False)
