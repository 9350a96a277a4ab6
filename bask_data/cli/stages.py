"""A command per stage, generated from its signature and the model of its parameters."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import Annotated, Any

import typer

from bask_data.cli import completion
from bask_data.cli.calls import call_of
from bask_data.cli.commands import CommandList
from bask_data.cli.options import (
    ONLY,
    Cluster,
    ConfigFile,
    Defaults,
    DryRun,
    Force,
    Jobs,
    Json,
    Preset,
    Root,
    Set,
    add_command,
    options_of,
    parameter,
)
from bask_data.cli.picking import pick, pick_options, refuse_without_pick
from bask_data.cli.running import AFTER_DRY_RUN, made, print_forecast
from bask_data.cli.working import finish
from bask_data.engine import PARAMS, Stage, follow, is_follower, run_pipeline
from bask_data.pipeline import STAGES
from bask_data.presets import PRESETS

EXAMPLES = {
    "reconstruct": """
    bask-data reconstruct data/demo
    bask-data reconstruct data/demo --only table --voxel-size 0.003
    """,
    "objects": """
    bask-data objects data/demo
    bask-data objects data/demo --only table --names mug,box --min-area 0.005
    """,
    "masks": """
    bask-data masks data/demo --jobs 4
    bask-data masks data/demo --tolerance 0.01
    """,
    "correspondences": """
    bask-data correspondences data/demo
    bask-data correspondences data/demo --n-pairs 400 --min-angle-deg 30
    """,
    "identify": """
    bask-data identify data/demo
    bask-data identify data/demo --names table1/2=mug,table1/3=box
    bask-data identify data/demo --same table1/2=table2/4 --different table1/3=table2/1
    """,
    "train": """
    bask-data train data/demo
    bask-data train data/demo --steps 500 --variant quick
    bask-data train data/demo --preset bask --variant paper
    torchrun --nproc-per-node 4 -m bask_data.cli train data/demo
    """,
    "reference": """
    bask-data reference data/demo --pick
    bask-data reference data/demo --auto --n 8
    """,
    "encode": """
    bask-data encode data/demo
    bask-data encode data/demo --only demo1 --filter discrete --variant discrete
    """,
}

app = CommandList()


def _signature(stage: Stage) -> list[inspect.Parameter]:
    """Parameters of the command: positional ones first, as a signature requires, then the everyday options."""
    parameters = [parameter("root", Root, inspect.Parameter.empty)]
    if stage.makes.scope != "dataset":
        parameters.append(parameter("only", ONLY[stage.makes.scope], ""))
    if stage.makes.has_variants:
        parameters += _variant_options(stage)
    parameters += [
        *options_of(stage.name, stage.params),
        parameter("force", Force, False),
        parameter("dry_run", DryRun, False),
        *(pick_options() if stage.makes.kind == "reference" else []),
        parameter("config", ConfigFile, None),
        *([parameter("preset", Preset, None)] if stage.name in PRESETS["bask"] else []),
        parameter("set_", Set, []),
        parameter("defaults", Defaults, False),
        parameter("jobs", Jobs, 1),
        parameter("cluster", Cluster, ""),
        parameter("json_", Json, False),
        parameter("stage_version", Annotated[int, typer.Option(hidden=True)], 0),
    ]
    return parameters


def _variant_options(stage: Stage) -> list[inspect.Parameter]:
    """Options for the variant to make, and for the variant of each input that has them."""

    def option(flag: str, kind: str, help: str) -> Any:
        completed = completion.variants_of(kind)
        return Annotated[str, typer.Option(flag, help=help, metavar="NAME", autocompletion=completed)]

    help = "Name of the variant to make, to keep several side by side."
    options = [parameter("variant", option("--variant", stage.makes.kind, help), "main")]
    for input_ in stage.inputs:
        if input_.artifact.has_variants:
            kind = input_.artifact.kind
            help = f"Variant of the {kind} to use. [default: that of --variant]"
            options.append(parameter(f"variant_of_{kind}", option(f"--{kind}", kind, help), ""))
    return options


def _run(stage: Stage, root: Path, dry_run: bool, force: bool, options: dict[str, Any]) -> None:
    call = call_of(stage, root, options)
    if is_follower():
        for task in call.tasks() if not dry_run else []:
            follow(task, force)
        return
    if options.get("pick"):
        outcomes = pick(call, parameters=options["config"] or root / PARAMS, dry_run=dry_run, options=options)
        finish(stage.name, outcomes, options["json_"], call.following if outcomes else "")
        return
    refuse_without_pick(options)
    if dry_run:
        outcomes = list(run_pipeline(call.dataset, STAGES, call.request, force=force, dry_run=True))
        if not options["json_"]:
            print_forecast(stage.name, outcomes, every=True)
        finish(stage.name, outcomes, options["json_"], AFTER_DRY_RUN)
        return
    outcomes = made(call.dataset, call.request, jobs=options["jobs"], cluster=options["cluster"], force=force)
    finish(stage.name, outcomes, options["json_"], call.following)


def _add(stage: Stage) -> None:
    def body(root: Path, dry_run: bool, force: bool, **options: Any) -> None:
        _run(stage, root, dry_run, force, options)

    add_command(app, stage.name, _signature(stage), body, help=stage.help, epilog=EXAMPLES.get(stage.name))


for _stage in STAGES:
    _add(_stage)
