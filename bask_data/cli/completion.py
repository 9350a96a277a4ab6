"""Shell completion of commands, recordings, variants and parameters."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import typer
from typer._click.shell_completion import CompletionItem
from typer._completion_classes import completion_init
from typer._completion_shared import get_completion_script

PROGRAM = "bask-data"
VARIABLE = "_BASK_DATA_COMPLETE"
"""Environment variable by which a shell asks the program for completions."""

SHELLS = ("bash", "zsh", "fish")

_BASH = """\
_bask_data_completion() {
    local IFS=$'\\n' program=$1
    COMPREPLY=( $(env COMP_WORDS="${COMP_WORDS[*]}" COMP_CWORD=$COMP_CWORD %s=complete_bash "$program") )
    # A parameter is followed by its value, without a space between.
    if [[ ${#COMPREPLY[@]} == 1 && ${COMPREPLY[0]} == *= ]]; then compopt -o nospace; fi
}

complete -o default -F _bask_data_completion bask-data"""

Completer = Callable[[typer.Context, str], list[str]]


def script(shell: str) -> str:
    """The script that a shell has to read to enable completion."""
    if shell == "bash":
        return _BASH % VARIABLE
    return get_completion_script(prog_name=PROGRAM, complete_var=VARIABLE, shell=shell)


def prepare() -> None:
    """Set the program up to answer a shell's request."""
    completion_init()


def items(names: Mapping[str, str], incomplete: str) -> list[CompletionItem]:
    """Names with this prefix, each with its help."""
    return [CompletionItem(name, help=text) for name, text in names.items() if name.startswith(incomplete)]


def recordings(context: typer.Context, incomplete: str) -> list[str]:
    """Scenes and demonstrations of the dataset given before; in a comma-separated list also the next one."""
    listed = _listed(context)
    return _not_listed_yet({**listed.get("scenes", {}), **listed.get("demonstrations", {})}, incomplete)


def scenes(context: typer.Context, incomplete: str) -> list[str]:
    """Scenes of the dataset given before."""
    return _not_listed_yet(_listed(context).get("scenes", {}), incomplete)


def demonstrations(context: typer.Context, incomplete: str) -> list[str]:
    """Demonstrations of the dataset given before."""
    return _not_listed_yet(_listed(context).get("demonstrations", {}), incomplete)


def variants_of(*kinds: str) -> Completer:
    """A completer for the variants of these kinds; of all kinds if none is named."""

    def complete(context: typer.Context, incomplete: str) -> list[str]:
        of_kind = _listed(context).get("variants", {})
        names = [name for kind in kinds or of_kind for name in of_kind.get(kind, {})]
        return _not_listed_yet(["main", *names], incomplete)

    return complete


def assignments(context: typer.Context, incomplete: str) -> list[str]:
    """`stage.field=` for every parameter."""
    from bask_data.pipeline import STAGES

    return [f"{stage.name}.{field}=" for stage in STAGES for field in stage.params.model_fields]


def _not_listed_yet(names: Iterable[str], incomplete: str) -> list[str]:
    """The comma-separated list so far, continued with each name that is not in it."""
    before = incomplete[: incomplete.rfind(",") + 1]
    taken = before.split(",")
    return [before + name for name in dict.fromkeys(names) if name not in taken]


def _listed(context: typer.Context) -> dict[str, Any]:
    """`dataset.json` unchecked, empty if it cannot be read: completion must be fast and silent."""
    try:
        document = json.loads((Path(context.params["root"]) / "dataset.json").read_text(encoding="utf-8"))
    except (KeyError, TypeError, OSError, ValueError):
        return {}
    return document if isinstance(document, dict) else {}
