"""Commands and groups of them, as Typer runs them: their help and their errors are ours, their modules load lazily."""

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
    """A command as its group lists it.

    Args:
        panel: heading it is listed under.
        module: of `bask_data.cli`, whose `app` has it. It is loaded when the command is used, and no other is.
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
    """A command whose usage errors name what was expected, what came and what to do."""

    allow_extra_args = True  # So that the words that are too many are ours to refuse.

    def parse_args(self, ctx: Context, args: list[str]) -> list[str]:
        """As Typer does, with errors of ours."""
        if ctx.resilient_parsing and args and args[-1].startswith("-"):
            # An option that is being completed has no value yet, over which the parser would forget the arguments.
            args = args[:-1]
        rest = parsed(self, super().parse_args, ctx, args)
        if rest and not ctx.resilient_parsing:
            raise usage.extra_arguments(rest, ctx)
        return rest

    def format_help(self, ctx: Context, formatter: Any) -> None:
        """Arguments and options under the headings of their panels, then examples."""
        formatter.write(help.rendered(self, ctx))


class BaskGroup(TyperGroup):
    """A group of commands; those of `entries` are loaded when they are used."""

    entries: tuple[ListedCommand, ...] = ()

    def list_commands(self, ctx: Context) -> list[str]:
        """Names in the order of the list."""
        return [*(entry.name for entry in self.entries), *super().list_commands(ctx)]

    def get_command(self, ctx: Context, cmd_name: str) -> Any:
        """The command, loaded if need be; None if there is no such."""
        for entry in self.entries:
            if entry.name == cmd_name:
                group = get_group(import_module(f"bask_data.cli.{entry.module}").app)
                return group.commands.get(cmd_name, group)
        return super().get_command(ctx, cmd_name)

    def summaries(self, ctx: Context) -> list[ListedCommand]:
        """The list of commands; none is loaded for it."""
        own = [
            ListedCommand(name, "Commands", "", (command.help or "").split("\n")[0])
            for name, command in self.commands.items()
        ]
        return [*self.entries, *own]

    def resolve_command(self, ctx: Context, args: list[str]) -> Any:
        """The command of the first word; `UsageError` if there is none of that name."""
        command = self.get_command(ctx, args[0])
        if command is None and not ctx.resilient_parsing:
            raise usage.unknown_command(args[0], self.list_commands(ctx), ctx)
        return args[0] if command else None, command, args[1:]

    def parse_args(self, ctx: Context, args: list[str]) -> list[str]:
        """As Typer does, with errors of ours; nothing at all asks for help."""
        if not args and self.no_args_is_help and not ctx.resilient_parsing:
            typer.echo(ctx.get_help(), err=True)
            raise typer.Exit(2)
        return parsed(self, super().parse_args, ctx, args)

    def invoke(self, ctx: Context) -> Any:
        """Run the command; what it raises becomes a line and an exit code."""
        with reported():
            try:
                return super().invoke(ctx)
            finally:
                sys.stdout.flush()  # Here, where it is caught that nobody reads any more.

    def main(self, *args: Any, **kwargs: Any) -> Any:
        """Run the command line and leave with the documented exit code."""
        try:
            return super().main(*args, **kwargs)
        except BaskError as error:  # Of the group's own options, before any command is invoked.
            show_error(error)
            sys.exit(error.exit_code)

    def shell_complete(self, ctx: Context, incomplete: str) -> list[Any]:
        """Names of the commands, read off the list, and the group's options."""
        names = {entry.name: entry.summary for entry in self.summaries(ctx)}
        return [*completion.items(names, incomplete), *super(TyperGroup, self).shell_complete(ctx, incomplete)]

    def format_help(self, ctx: Context, formatter: Any) -> None:
        """Commands under the headings of their panels."""
        formatter.write(
            help.rendered(self, ctx, [(each.panel, each.name, each.summary) for each in self.summaries(ctx)])
        )


class CommandList(typer.Typer):
    """Commands of one module, or sub-commands of one command.

    Help, completion and errors are made in this package, not by Typer.
    """

    def __init__(self, **settings: Any) -> None:
        plain = {"rich_markup_mode": None, "add_completion": False, "pretty_exceptions_enable": False}
        super().__init__(**{"cls": BaskGroup, **plain, **settings})

    def command(self, name: str | None = None, **settings: Any) -> Any:
        """Declare the function below as a command."""
        return super().command(name, **{"cls": BaskCommand, **settings})


def parsed(
    command: Any, parse: Callable[[Context, list[str]], list[str]], context: Context, args: Sequence[str]
) -> list[str]:
    """The words that the parser leaves over.

    Raises:
        UsageError: it refuses one.
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
