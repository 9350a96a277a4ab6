"""`ingest auto`: which format a recording has, and the command that reads it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from bask_data.cli.console import print_result, say
from bask_data.cli.ingest_run import IngestRequest, command_of, flag_of, run_ingest
from bask_data.cli.options import Json, Root
from bask_data.cli.working import quoted
from bask_data.errors import BaskError, UsageError
from bask_data.formats import FORMATS, Format
from bask_data.formats.guess import Guess

SourceAny = Annotated[Path, typer.Argument(help="A folder or file.", metavar="SOURCE", exists=True)]
SceneIfAny = Annotated[
    str, typer.Option("--scene", help="Name of the recording. [default: SOURCE's name]", metavar="NAME")
]
AsIfAny = Annotated[
    Literal["scan", "demonstration"] | None,
    typer.Option("--as", help="A scan or a demonstration. [default: a demonstration if there is a robot]"),
]
Yes = Annotated[bool, typer.Option("--yes", help="Run the command.")]
Replace = Annotated[bool, typer.Option("--force", help="Replace an existing recording.")]


def ingest_auto(
    source: SourceAny,
    root: Root,
    *,
    scene: SceneIfAny = "",
    as_: AsIfAny = None,
    yes: Yes = False,
    force: Replace = False,
    json_: Json = False,
) -> None:
    """Say which format a recording has, and the command that reads it; --yes runs it."""
    from bask_data.dataset import plain_name
    from bask_data.formats.recognise import recognise

    recognition = recognise(source)
    requests = []
    for guess in map(_with_episodes, recognition.guesses):
        kind = as_ or ("demonstration" if guess.has_robot else "scan")
        name = scene or plain_name(source.resolve().stem if source.is_file() else source.resolve().name)
        requests.append(
            (
                guess,
                IngestRequest(
                    _format(guess), guess.source, root, name, kind, dict(guess.options), force=force, as_json=json_
                ),
            )
        )
    if len(requests) != 1:
        _refuse(source, root, recognition.got, recognition.fix, requests, json_)
    [(guess, request)] = requests
    command = command_of(request, guess.missing)
    if guess.missing and yes:
        raise UsageError(
            "ingest auto",
            "--yes",
            expected=f"a recording that states {' and '.join(guess.missing)}",
            got="none in its files",
            fix=f"put yours in: {command}",
        )
    if yes:
        for reason in guess.reasons:
            say(f"  found       {reason}")
        say(f"  running     {command}")
        run_ingest(request)
        return
    lines = [f"{guess.format}: {'; '.join(guess.reasons)}", command]
    print_result("ingest auto", lines, _described(guess, command), json_)
    if not json_:
        missing = " and ".join(f"--{flag_of(name)}" for name in guess.missing)
        say(f"next: put in {missing}, which no file states, and run it." if missing else "next: run it, or add --yes.")


def _refuse(
    source: Path, root: Path, got: str, fix: str, requests: list[tuple[Guess, IngestRequest]], as_json: bool
) -> None:
    """Raise `UsageError`: no format was recognised, or several were, which are listed."""
    if not requests:
        fix = fix.replace(" ROOT", f" {quoted(root)}")
        raise UsageError(source, "SOURCE", expected="a recording of a known format", got=got, fix=fix)
    described = [_described(guess, command_of(request, guess.missing)) for guess, request in requests]
    lines = [
        line for each in described for line in (f"{each['format']}: {'; '.join(each['reasons'])}", each["command"])
    ]
    print_result("ingest auto", lines, {"candidates": described}, as_json)
    raise UsageError(
        source,
        "SOURCE",
        expected="files of one format",
        got=f"those of {len(requests)}: {', '.join(guess.format for guess, _ in requests)}",
        fix="run the command that you mean.",
    )


def _described(guess: Guess, command: str) -> dict[str, Any]:
    return {"format": guess.format, "command": command, "reasons": list(guess.reasons), "missing": list(guess.missing)}


def _format(guess: Guess) -> Format:
    return next(format for format in FORMATS if format.name == guess.format)


def _with_episodes(guess: Guess) -> Guess:
    """The guess with the source's episodes, if there are several."""
    format = _format(guess)
    try:
        names = format.episodes(guess.source, format.options.model_validate(guess.options))
    except BaskError as error:
        return replace(guess, reasons=(*guess.reasons, f"its episodes cannot be listed: {error}"))
    if len(names) < 2:
        return guess
    shown = ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")
    reason = f"{len(names)} episodes: {shown}"
    return replace(guess, reasons=(*guess.reasons, reason), options={**guess.options, "episode": "all"})
