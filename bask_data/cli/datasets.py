"""Commands for a dataset as a whole: `init`, `split`, `info` and `validate`."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated

import typer

from bask_data.cli import completion
from bask_data.cli.commands import CommandList
from bask_data.cli.console import print_result, say, shown_progress
from bask_data.cli.options import Json, Root, names_of
from bask_data.cli.working import quoted
from bask_data.dataset import DATASET, Dataset, DatasetFile, Splits
from bask_data.errors import BadData
from bask_data.spelling import number_of

if TYPE_CHECKING:
    from bask_data.contents import Holding

app = CommandList()


@app.command(
    epilog="""
    bask-data init data/demo
    bask-data init data/demo --name kitchen --licence CC-BY-4.0
    """
)
def init(
    root: Root,
    name: Annotated[str, typer.Option(help="Name of the dataset. [default: the directory's]")] = "",
    licence: Annotated[str, typer.Option(help="Licence of the data, as an SPDX identifier.")] = "",
    json_: Json = False,
) -> None:
    """Create an empty dataset.

    `ingest` also creates one if there is none.
    """
    dataset = Dataset.create(root, name, licence)
    say(f"made {dataset.root / DATASET}")
    print_result("init", [], {"root": str(root), "name": dataset.file.name}, json_)
    say(f"next: bask-data ingest frames SOURCE {quoted(root)} --scene NAME ...")


@app.command(
    epilog="""
    bask-data info data/demo
    bask-data info data/demo --json | jq '.artifacts[] | .artifact'
    """
)
def info(root: Root, json_: Json = False) -> None:
    """List the contents of a dataset.

    Recordings, splits, and each artifact with its size and content digest. Exits with code 4 if one is damaged.
    """
    from bask_data.contents import contents

    dataset = Dataset(root)
    holdings = contents(dataset)
    document = {"dataset": dataset.file.model_dump(mode="json"), "artifacts": [vars(holding) for holding in holdings]}
    print_result("info", _info_lines(dataset.file, holdings), document, json_)
    faults = [holding.fault for holding in holdings if holding.fault]
    for fault in faults:
        say(f"error: {fault}")
    if faults:
        raise typer.Exit(BadData.exit_code)


def _info_lines(file: DatasetFile, holdings: list[Holding]) -> Iterator[str]:
    yield (
        f"{file.name}: {number_of(len(file.scenes), 'scene')}, {number_of(len(file.demonstrations), 'demonstration')}, "
        f"licence {file.licence or 'not stated'}"
    )
    for holding in holdings:
        if holding.fault:
            yield f"  {holding.artifact:<40} damaged"
            continue
        cameras = ", ".join(f"{name} {size}" for name, size in holding.cameras.items())
        yield f"  {holding.artifact:<40} {holding.bytes / 1e6:9.1f} MB  {holding.digest[:12]}  {cameras}".rstrip()
        yield from (f"    {line}" for line in holding.stated)
    yield from _split_lines(file.splits)


@app.command(
    epilog="""
    bask-data validate data/demo
    """
)
def validate(root: Root, json_: Json = False) -> None:
    """Check every file against its SHA-256 and every array against its schema.

    Exits with code 4 if there is a problem; each is printed with its fix.
    """
    from bask_data.validate import artifacts_on_disk
    from bask_data.validate import validate as find_problems

    dataset = Dataset(root)
    with shown_progress():
        problems = find_problems(dataset)
    lines = [str(problem) for problem in problems]
    lines.append(
        f"{len(artifacts_on_disk(dataset))} artifacts, {len(problems) or 'no'} problem{'s'[: len(problems) != 1]}."
    )
    print_result("validate", lines, {"problems": [vars(problem) for problem in problems]}, json_)
    if problems:
        raise typer.Exit(BadData.exit_code)


@app.command(
    epilog="""
    bask-data split data/demo --train table1,table2 --validation table3
    bask-data split data/demo --validation table3
    """
)
def split(
    root: Root,
    train: Annotated[
        str,
        typer.Option(
            help="Scenes to train on, separated by commas.", metavar="NAMES", autocompletion=completion.scenes
        ),
    ] = "",
    validation: Annotated[
        str, typer.Option(help="Scenes to validate on.", metavar="NAMES", autocompletion=completion.scenes)
    ] = "",
    test: Annotated[
        str, typer.Option(help="Scenes to test on.", metavar="NAMES", autocompletion=completion.scenes)
    ] = "",
    json_: Json = False,
) -> None:
    """Assign scenes to training, validation and test.

    Splits are by scene, never by frame, because frames of one scene resemble each other. The names replace all those
    given before. Without --train, all scenes that are in no other split are for training.
    """
    splits = Splits(train=tuple(names_of(train)), validation=tuple(names_of(validation)), test=tuple(names_of(test)))
    Dataset(root).set_splits(splits)
    print_result("split", _split_lines(splits) or ["no splits"], splits.model_dump(mode="json"), json_)
    say(f"next: bask-data train {quoted(root)}")


def _split_lines(splits: Splits) -> list[str]:
    return [f"  {name}: {', '.join(scenes)}" for name, scenes in splits.model_dump().items() if scenes]
