"""Typer commands and command groups with our own help and errors, whose modules load lazily."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import typer
from typer._click.core import Context
from typer.core import TyperCommand, TyperGroup
from typer.main import get_group

from bask_data.cli import completion, help, usage
from bask_data.cli.console import show_error
from bask_data.cli.failures import reported
from bask_data.errors import BaskError

HELP_FLAGS = {"help_option_names": ["-h", "--help"]}


@dataclass(frozen=True)
class ListedCommand:
    """A command as listed by its group.

    Args:
        panel: heading in the list.
        module: in `bask_data.cli`, with the command in its `app`; loaded only when the command is used.
        summary: the first sentence of its help.
    """

    name: str
    panel: str
    module: str
    summary: str


def under(panel: str, *commands: tuple[str, str, str]) -> tuple[ListedCommand, ...]:
    """Entries under one heading, from (name, module, summary)."""
    return tuple(ListedCommand(name, panel, module, summary) for name, module, summary in commands)


class BaskCommand(TyperCommand):
    """A command whose usage errors state what was expected, what was given and the fix."""

    allow_extra_args = True  # Superfluous arguments then reach `parse_args`, which refuses them in our words.

    def parse_args(self, ctx: Context, args: list[str]) -> list[str]:
        """Parse as Typer does, with our own errors."""
        if ctx.resilient_parsing and args and args[-1].startswith("-"):
            # An option that is being completed has no value yet; the parser would then drop the arguments.
            args = args[:-1]
        rest = parsed(self, super().parse_args, ctx, args)
        if rest and not ctx.resilient_parsing:
            raise usage.extra_arguments(rest, ctx)
        return rest

    def format_help(self, ctx: Context, formatter: Any) -> None:
        """Write arguments and options under their panels' headings, then examples."""
        formatter.write(help.rendered(self, ctx))


class BaskGroup(TyperGroup):
    """A group of commands; those in `entries` are loaded on use."""

    entries: tuple[ListedCommand, ...] = ()

    def list_commands(self, ctx: Context) -> list[str]:
        """Names of the commands, in listed order."""
        return [*(entry.name for entry in self.entries), *super().list_commands(ctx)]

    def get_command(self, ctx: Context, cmd_name: str) -> Any:
        """The command of that name, loaded if necessary; None if there is none."""
        for entry in self.entries:
            if entry.name == cmd_name:
                group = get_group(import_module(f"bask_data.cli.{entry.module}").app)
                return group.commands.get(cmd_name, group)
        return super().get_command(ctx, cmd_name)

    def summaries(self, ctx: Context) -> list[ListedCommand]:
        """The listed commands, without loading any."""
        own = [
            ListedCommand(name, "Commands", "", (command.help or "").split("\n")[0])
            for name, command in self.commands.items()
        ]
        return [*self.entries, *own]

    def resolve_command(self, ctx: Context, args: list[str]) -> Any:
        """The command named by the first argument; `UsageError` if it does not exist."""
        command = self.get_command(ctx, args[0])
        if command is None and not ctx.resilient_parsing:
            raise usage.unknown_command(args[0], self.list_commands(ctx), ctx)
        return args[0] if command else None, command, args[1:]

    def parse_args(self, ctx: Context, args: list[str]) -> list[str]:
        """Parse as Typer does, with our own errors; no arguments print the help."""
        if not args and self.no_args_is_help and not ctx.resilient_parsing:
            typer.echo(ctx.get_help(), err=True)
            raise typer.Exit(2)
        return parsed(self, super().parse_args, ctx, args)

    def invoke(self, ctx: Context) -> Any:
        """Run the command; an exception becomes an error line and an exit code."""
        with reported():
            try:
                return super().invoke(ctx)
            finally:
                if sys.stdout is not None:  # It is None if it was closed from the start: `>&-`.
                    sys.stdout.flush()  # Here, because a closed pipe is handled here.

    def main(self, *args: Any, **kwargs: Any) -> Any:
        """Run the command line and exit with the documented code."""
        try:
            return super().main(*args, **kwargs)
        except BaskError as error:  # From the group's own options, before any command is invoked.
            show_error(error)
            sys.exit(error.exit_code)

    def shell_complete(self, ctx: Context, incomplete: str) -> list[Any]:
        """Completions: the listed commands and the group's options."""
        names = {entry.name: entry.summary for entry in self.summaries(ctx)}
        return [*completion.items(names, incomplete), *super(TyperGroup, self).shell_complete(ctx, incomplete)]

    def format_help(self, ctx: Context, formatter: Any) -> None:
        """Write the commands under their panels' headings."""
        formatter.write(
            help.rendered(self, ctx, [(entry.panel, entry.name, entry.summary) for entry in self.summaries(ctx)])
        )


class CommandList(typer.Typer):
    """The commands of one module, or the sub-commands of one command.

    Help, completion and errors come from this package, not from Typer.
    """

    def __init__(self, **settings: Any) -> None:
        plain = {"rich_markup_mode": None, "add_completion": False, "pretty_exceptions_enable": False}
        super().__init__(**{"cls": BaskGroup, **plain, **settings})

    def command(self, name: str | None = None, **settings: Any) -> Any:
        """Decorator that declares a function as a command."""
        return super().command(name, **{"cls": BaskCommand, **settings})


def parsed(
    command: Any, parse: Callable[[Context, list[str]], list[str]], context: Context, args: Sequence[str]
) -> list[str]:
    """The arguments that the parser did not consume.

    Raises:
        UsageError: the parser refused an argument or option.
    """
    try:
        return parse(context, list(args))
    except typer.TyperException as error:
        refused = error
    try:
        values, _, _ = command.make_parser(context).parse_args(args=list(args))
    except typer.TyperException:
        values = {}
    raise usage.from_parser(refused, context, values)
