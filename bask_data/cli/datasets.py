"""Commands over a dataset as a whole: `init`, `info`, `validate`, `split`, `dvc` and `doctor`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from bask_data.cli.console import say, shown_progress
from bask_data.cli.failures import reporting
from bask_data.cli.options import ConfigFile, Json, Preset, Root, names_of
from bask_data.cli.working import parameters_of, quoted
from bask_data.dataset import DATASET, Dataset, Splits
from bask_data.errors import MissingDependency, UsageError
from bask_data.pipeline import STAGES

app = typer.Typer(rich_markup_mode=None)


@app.command()
@reporting
def init(
    root: Root,
    name: Annotated[str, typer.Option(help="Name of the dataset; by default the directory's.")] = "",
    licence: Annotated[str, typer.Option(help="Licence of the data: an SPDX identifier.")] = "",
    json_: Json = False,
) -> None:
    """Make an empty dataset."""
    dataset = Dataset.create(root, name, licence)
    say(f"made {dataset.root / DATASET}")
    if json_:
        print(json.dumps({"command": "init", "root": str(root), "name": dataset.file.name}))
    say(f"next: bask-data ingest frames SOURCE {quoted(root)} --scene NAME ...")


@app.command()
@reporting
def info(root: Root, json_: Json = False) -> None:
    """Say what a dataset holds."""
    from bask_data.validate import artifacts_on_disk, total_bytes

    dataset = Dataset(root)
    file = dataset.file
    say(
        f"{file.name}: {len(file.scenes)} scenes, {len(file.demonstrations)} demonstrations, "
        f"licence {file.licence or 'not stated'}"
    )
    rows = []
    for artifact in artifacts_on_disk(dataset):
        manifest = artifact.manifest
        rows.append(
            {
                "artifact": artifact.path.relative_to(dataset.root).as_posix(),
                "made_by": f"{manifest.stage} v{manifest.stage_version}",
                "bytes": total_bytes(manifest.files),
                "digest": manifest.digest,
                "metadata": {key: value for key, value in artifact.attributes.items() if key not in ("kind", "schema")},
                "cameras": _camera_sizes(artifact),
            }
        )
        cameras = ", ".join(f"{name} {size}" for name, size in rows[-1]["cameras"].items())  # type: ignore[attr-defined]
        megabytes = total_bytes(manifest.files) / 1e6
        say(f"  {rows[-1]['artifact']:<40} {megabytes:9.1f} MB  {manifest.digest[:12]}  {cameras}")
    for name, scenes in file.splits.model_dump().items():
        if scenes:
            say(f"  {name}: {', '.join(scenes)}")
    if json_:
        print(json.dumps({"command": "info", "dataset": file.model_dump(mode="json"), "artifacts": rows}, indent=2))


def _camera_sizes(artifact: Any) -> dict[str, str]:
    from bask_data.kinds import Recording

    if not isinstance(artifact, Recording):
        return {}
    return {camera.name: f"{camera.n_frames} x {camera.width}x{camera.height}" for camera in artifact.cameras}


@app.command()
@reporting
def validate(root: Root, json_: Json = False) -> None:
    """Hold every file against its SHA-256 and every array against its schema."""
    from bask_data.validate import artifacts_on_disk
    from bask_data.validate import validate as find_problems

    dataset = Dataset(root)
    with shown_progress():
        problems = find_problems(dataset)
    for problem in problems:
        say(f"error: {problem}")
    if json_:
        print(json.dumps({"command": "validate", "problems": [vars(problem) for problem in problems]}, indent=2))
    if problems:
        say(f"{len(problems)} problems.")
        raise typer.Exit(4)
    say(f"{len(artifacts_on_disk(dataset))} artifacts, no problem.")


@app.command()
@reporting
def split(
    root: Root,
    train: Annotated[str, typer.Option(help="Scenes to train on, separated by commas.", metavar="NAMES")] = "",
    validation: Annotated[str, typer.Option(help="Scenes to validate on.", metavar="NAMES")] = "",
    test: Annotated[str, typer.Option(help="Scenes kept for the test.", metavar="NAMES")] = "",
    json_: Json = False,
) -> None:
    """Say which scenes are for training, validation and test; never splits the frames of a scene."""
    splits = Splits(train=tuple(names_of(train)), validation=tuple(names_of(validation)), test=tuple(names_of(test)))
    Dataset(root).set_splits(splits)
    if json_:
        print(json.dumps({"command": "split", **splits.model_dump(mode="json")}))
    say(f"next: bask-data train {quoted(root)}")


@app.command()
@reporting
def dvc(
    root: Root,
    config: ConfigFile = None,
    preset: Preset = None,
    check: Annotated[
        bool, typer.Option("--check", help="Only say whether the files are what would be written.")
    ] = False,
    json_: Json = False,
) -> None:
    """Write dvc.yaml and params.yaml, so that `dvc repro` runs and records the pipeline."""
    from bask_data.dvc import render

    dataset = Dataset(root)
    rendered = render(dataset, STAGES, parameters_of(root, config, [], preset))
    stale = [name for name, text in rendered.items() if not (root / name).exists() or (root / name).read_text() != text]
    if json_:
        print(json.dumps({"command": "dvc", "files": sorted(rendered), "changed": stale}))
    if check:
        if stale:
            raise UsageError(
                root,
                ", ".join(stale),
                expected="what the code renders",
                got="something else",
                fix=f"bask-data dvc {root}",
            )
        return
    for name in stale:
        (root / name).write_text(rendered[name])
        say(f"made {root / name}")
    for stage in STAGES:
        for variant in dataset.variants(stage.makes):
            dataset.prepare(stage.makes, variant)
    say(f"next: dvc repro {quoted(root / 'dvc.yaml')}")


@app.command()
@reporting
def doctor(
    folder: Annotated[Path | None, typer.Option(help="Where datasets will go: is there room?", metavar="DIR")] = None,
    json_: Json = False,
) -> None:
    """Say what this machine lacks, and the line that brings it."""
    from bask_data import doctor as examiner

    found = examiner.checks(folder)
    say(examiner.render(found))
    if json_:
        print(examiner.as_json(found))
    if examiner.missing(found):
        raise typer.Exit(MissingDependency.exit_code)
