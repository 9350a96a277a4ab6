"""`doctor`: what is wrong with a recording, a dataset or this machine."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer
from typer.main import get_command

from bask_data.cli import completion
from bask_data.cli.commands import CommandList
from bask_data.cli.console import print_result, say, shown_progress
from bask_data.cli.ingest import app as ingest_app
from bask_data.cli.ingest_run import IngestRequest, command_of
from bask_data.cli.options import Json, checked_options, given_options, names_of
from bask_data.dataset import DATASET, Dataset, plain_name
from bask_data.errors import BadData, MissingDependency, UsageError
from bask_data.formats import FORMATS
from bask_data.formats.options.common import SourceOptions

if TYPE_CHECKING:
    from bask_data.doctor.examination import Examination
    from bask_data.doctor.sources import AskedSource

app = CommandList()

AnyPath = Annotated[
    Path | None,
    typer.Argument(
        help="A recording in any format, or a dataset. [default: this machine]", metavar="[PATH]", exists=True
    ),
]
OnlyRecordings = Annotated[
    str,
    typer.Option(
        help="Of a dataset, only these scenes and demonstrations, separated by commas.",
        metavar="NAMES",
        autocompletion=completion.recordings,
    ),
]
ReadAs = Annotated[
    str,
    typer.Option(
        help="Format of a recording and its options, as after `bask-data ingest`: 'frames --depth-scale 0.001'. "
        "[default: as `ingest auto` says]",
        metavar="'FORMAT ...'",
    ),
]
FailOnOption = Annotated[
    Literal["error", "warning", "warn", "note", "never"],
    typer.Option(help="Exit with code 4 if there is a finding of this severity or worse."),
]
Report = Annotated[Path | None, typer.Option(help="Write the findings with pictures as an HTML page.", metavar="FILE")]
Folder = Annotated[
    Path | None, typer.Option(help="Of the machine: folder for datasets, to check for free space.", metavar="DIR")
]


@app.command(
    epilog="""
    bask-data doctor recordings/table
    bask-data doctor recordings/table --read-as 'frames --intrinsics 525,525,319.5,239.5' --report table.html
    bask-data doctor data/demo --only table1,table2
    bask-data doctor data/demo --fail-on warn --json > findings.json
    bask-data doctor --folder /data
    """
)
def doctor(
    root: AnyPath = None,
    *,
    only: OnlyRecordings = "",
    read_as: ReadAs = "",
    fail_on: FailOnOption = "error",
    report: Report = None,
    folder: Folder = None,
    json_: Json = False,
) -> None:
    """Say what is wrong with a recording, a dataset or this machine, and how to mend it.

    With a recording or a dataset: whether poses, units, intrinsics and clock are meant as they are read, whether depth
    lies on colour, what is wrong with frames, and what of a dataset leaks, is empty, damaged or out of date. Each
    finding has a code, a severity (error: results will be wrong; warning: look at it; note: good to know), evidence and
    a fix. Nothing is written. Exits with code 4 if a finding reaches --fail-on.

    Without an argument: checks this machine, and exits with code 5 if something that every command needs is missing.
    """
    if root is None:
        _refuse_without_path(only=only, read_as=read_as, report=report)
        _examine_machine(folder, json_)
        return
    from bask_data.doctor.text import document, fails, lines

    with shown_progress():
        examination = _examined(root, only, read_as, report is not None)
    print_result("doctor", lines(examination), document(examination, fail_on), json_)
    if report is not None:
        from bask_data.doctor.page import write_page

        say(f"  made        {write_page(examination, report)}")
    if fails(examination, fail_on):
        raise typer.Exit(BadData.exit_code)


def _refuse_without_path(**options: object) -> None:
    for name, value in options.items():
        if value:
            flag = f"--{name.replace('_', '-')}"
            fix = "name the recording or the dataset: `bask-data doctor PATH`."
            raise UsageError("bask-data doctor", flag, expected="a PATH", got="none", fix=fix)


def _examine_machine(folder: Path | None, as_json: bool) -> None:
    from bask_data.doctor import machine as examiner

    checks = examiner.checks(folder)
    print(examiner.as_json(checks) if as_json else examiner.render(checks))
    if examiner.missing(checks):
        raise typer.Exit(MissingDependency.exit_code)


def _examined(path: Path, only: str, read_as: str, with_pictures: bool) -> Examination:
    if (path / DATASET).exists():
        from bask_data.doctor.stored import examine_dataset

        if read_as:
            fix = "leave it out: a dataset says how it was read."
            raise UsageError("bask-data doctor", "--read-as", expected="a recording", got="a dataset", fix=fix)
        return examine_dataset(Dataset(path), names_of(only), with_pictures)
    from bask_data.doctor.sources import examine_source

    if only:
        fix = "leave it out, or choose frames and episodes by --read-as 'FORMAT --frames ... --episode ...'."
        raise UsageError("bask-data doctor", "--only", expected="a dataset", got="a recording", fix=fix)
    asked = _requested(path, read_as) if read_as else _recognised(path)
    try:
        return examine_source(asked, with_pictures)
    except UsageError as error:
        error.add_note(f"give options of {asked.format.name} by --read-as '{asked.format.name} --option value'.")
        raise


def _requested(source: Path, read_as: str) -> AskedSource:
    """The format and options that `--read-as` states, parsed by the format's own command."""
    from bask_data.doctor.sources import AskedSource

    try:
        name, *words = shlex.split(read_as) or [""]
    except ValueError as error:
        got = f"{read_as!r}: {error}"
        raise UsageError("bask-data doctor", "--read-as", expected="a format and its options", got=got) from error
    format = next((each for each in FORMATS if each.name == name), None)
    if format is None:
        known = ", ".join(each.name for each in FORMATS)
        raise UsageError("bask-data doctor", "--read-as", expected=f"one of {known}", got=repr(name))
    command = get_command(ingest_app).commands[name]  # type: ignore[attr-defined]
    context = command.make_context(f"bask-data ingest {name}", [str(source), ".", "--scene", "any", *words])
    given = given_options(format.options, context.params)
    options = checked_options(format.options, context.params, f"bask-data ingest {name}")
    assert isinstance(options, SourceOptions)
    return AskedSource(format, source, options, _command(format.name, source, given))


def _recognised(source: Path) -> AskedSource:
    """The format that a source has, as `ingest auto` tells it."""
    from bask_data.doctor.sources import AskedSource
    from bask_data.formats.recognise import recognise

    recognition = recognise(source)
    if len(recognition.guesses) != 1:
        formats = ", ".join(guess.format for guess in recognition.guesses)
        got = f"those of {formats}" if formats else recognition.got
        again = f"bask-data doctor {shlex.quote(str(source))} --read-as FORMAT"
        fix = again if formats else recognition.fix.replace("bask-data ingest auto", "bask-data doctor")
        raise UsageError(
            source,
            "PATH",
            expected="a dataset, or a recording of a known format",
            got=got,
            fix=fix.replace(" ROOT", ""),
        )
    [guess] = recognition.guesses
    if guess.missing:
        placeholders = " ".join(f"--{name.replace('_', '-')} {value}" for name, value in guess.missing.items())
        given = " ".join(f"--{name.replace('_', '-')} {shlex.quote(value)}" for name, value in guess.options.items())
        words = " ".join(part for part in (guess.format, given, placeholders) if part)
        raise UsageError(
            source,
            "PATH",
            expected=f"a recording that states {' and '.join(guess.missing)}",
            got="none in its files",
            fix=f"put yours in: bask-data doctor {shlex.quote(str(source))} --read-as {shlex.quote(words)}",
        )
    format = next(each for each in FORMATS if each.name == guess.format)
    options = format.options.model_validate(given_options(format.options, dict(guess.options)))
    return AskedSource(format, guess.source, options, _command(format.name, guess.source, dict(guess.options)))


def _command(format: str, source: Path, options: dict[str, object]) -> str:
    """The command that reads a source so, with a placeholder for the dataset."""
    [found] = [each for each in FORMATS if each.name == format]
    name = plain_name(source.resolve().stem)
    return command_of(IngestRequest(found, source, Path("ROOT"), name, "scan", dict(options)), {})
