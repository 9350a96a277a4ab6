"""A command per stage, read off its signature and the model of its parameters."""

from __future__ import annotations

import functools
import inspect
from pathlib import Path
from typing import Annotated, Any

import typer

from bask_data.cli.console import show_outcome, shown_progress
from bask_data.cli.options import (
    Cluster,
    ConfigFile,
    DryRun,
    Force,
    Jobs,
    Json,
    Only,
    Preset,
    Root,
    Set,
    add_command,
    given_options,
    names_of,
    option_of,
    parameter,
)
from bask_data.cli.picking import pick, pick_options, refuse_without_pick
from bask_data.cli.working import AFTER_DRY_RUN, executor_of, finish, parameters_of, quoted, show_findings
from bask_data.dataset import Dataset, Variant
from bask_data.engine import Stage, follow, foretold, is_follower, plan, run
from bask_data.errors import UsageError
from bask_data.pipeline import STAGES
from bask_data.presets import PRESETS

app = typer.Typer(rich_markup_mode=None)


def _add_stage(stage: Stage) -> None:
    # Positional parameters first, as a signature wants them.
    parameters = [parameter("root", Root, inspect.Parameter.empty)]
    if stage.makes.scope != "dataset":
        parameters.append(parameter("only", Only, ""))
    if stage.makes.has_variants:
        option = typer.Option(
            "--variant", help="Name of this result, to keep several beside each other.", metavar="NAME"
        )
        parameters.append(parameter("variant", Annotated[str, option], "main"))
        for given in stage.inputs:
            if given.artifact.has_variants:
                kind = given.artifact.kind
                option = typer.Option(
                    f"--{kind}", help=f"Variant of the {kind} to use. [default: that of --variant]", metavar="NAME"
                )
                parameters.append(parameter(f"variant_of_{kind}", Annotated[str, option], ""))
    parameters += [option_of(name, field) for name, field in stage.params.model_fields.items()]
    parameters += pick_options() if stage.makes.kind == "reference" else []
    parameters += [
        parameter("jobs", Jobs, 1),
        parameter("cluster", Cluster, ""),
        parameter("force", Force, False),
        parameter("config", ConfigFile, None),
        *([parameter("preset", Preset, None)] if stage.name in PRESETS["bask"] else []),
        parameter("set_", Set, []),
        parameter("dry_run", DryRun, False),
        parameter("json_", Json, False),
        parameter("stage_version", Annotated[int, typer.Option(hidden=True)], 0),
    ]

    def body(
        root: Path, config: Path | None, set_: list[str], dry_run: bool, json_: bool, force: bool, **options: Any
    ) -> None:
        if options["stage_version"] not in (0, stage.version):
            raise UsageError(
                stage.name,
                "--stage-version",
                expected=str(stage.version),
                got=options["stage_version"],
                fix=f"bask-data dvc {root}",
            )
        dataset = Dataset(root)
        if not is_follower():
            dataset.recover()
        variant = options.get("variant", "main")
        chosen = {
            name.removeprefix("variant_of_"): value
            for name, value in options.items()
            if name.startswith("variant_of_") and value
        }
        planned = functools.partial(
            plan,
            dataset,
            stage,
            config=parameters_of(root, config, set_, options.get("preset")),
            only=names_of(options.get("only", "")),
            variant=variant,
            variant_inputs=chosen,
        )
        given = given_options(stage.params, options)
        tasks = planned(options=given)
        if not tasks:
            raise UsageError(
                root, "", expected=f"a {stage.makes.scope}", got="none in the dataset", fix="bask-data ingest --help"
            )
        if is_follower():
            for task in tasks if not dry_run else []:
                follow(task, force)
            return
        outcomes = []
        following = AFTER_DRY_RUN if dry_run else _following(stage, root, variant, chosen)
        if options.get("pick"):
            outcomes = pick(
                dataset,
                planned=lambda new: planned(options={**given, **new})[0],
                parameters=config or root / "params.yaml",
                following=following,
                inputs=chosen,
                dry_run=dry_run,
                options=options,
            )
        else:
            refuse_without_pick(options)
            with shown_progress(), executor_of(options["jobs"], options["cluster"]) as executor:
                for outcome in foretold(tasks, set(), force) if dry_run else run(tasks, executor=executor, force=force):
                    show_outcome(outcome)
                    show_findings(outcome)
                    outcomes.append(outcome)
        if variant != "main" and not dry_run and any(outcome.status == "made" for outcome in outcomes):
            dataset.add_variant(stage.makes, variant, Variant(inputs=chosen))
        saved_nothing = bool(options.get("pick")) and not outcomes
        finish(stage.name, outcomes, json_, "" if saved_nothing else following)

    add_command(app, stage.name, stage.help, parameters, body)


def _following(stage: Stage, root: Path, variant: str, chosen: dict[str, str]) -> str:
    """The command that goes on with what a stage has made, in the same variants."""
    later = [other for other in STAGES if stage.makes in [given.artifact for given in other.inputs]]
    if not later:
        return f"bask-data report {quoted(root)}"
    own = {given.artifact.kind for given in stage.inputs if given.artifact.has_variants}
    shared = [given.artifact.kind for given in later[0].inputs if given.artifact.kind in own]
    variants = {stage.makes.kind: variant, **{kind: chosen.get(kind, variant) for kind in shared}}
    words = [f"--{kind} {name}" for kind, name in variants.items() if name != "main"]
    return " ".join([f"bask-data {later[0].name} {quoted(root)}", *words])


for _stage in STAGES:
    _add_stage(_stage)
