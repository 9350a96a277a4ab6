"""Commands for the whole pipeline: `run` and `status`."""

from __future__ import annotations

import time

from bask_data.cli.commands import CommandList
from bask_data.cli.console import duration, print_result, say
from bask_data.cli.options import (
    All,
    Cluster,
    ConfigFile,
    Defaults,
    DryRun,
    Force,
    Jobs,
    Json,
    Only,
    Preset,
    Root,
    Set,
    names_of,
)
from bask_data.cli.running import AFTER_DRY_RUN, made, print_forecast, result_lines, standing_lines
from bask_data.cli.working import finish, quoted, request_of, with_options
from bask_data.dataset import Dataset
from bask_data.engine import run_pipeline
from bask_data.engine import status as standings
from bask_data.pipeline import STAGES

app = CommandList()


@app.command(
    "run",
    epilog="""
    bask-data run data/demo --dry-run
    bask-data run data/demo --only table --jobs 4
    bask-data run data/demo --set train.steps=500 --set reconstruct@table.voxel_size=0.003
    """,
)
def run_all(
    root: Root,
    only: Only = "",
    force: Force = False,
    dry_run: DryRun = False,
    all_: All = False,
    config: ConfigFile = None,
    preset: Preset = None,
    set_: Set = [],  # noqa: B006  # Typer copies it.
    defaults: Defaults = False,
    jobs: Jobs = 1,
    cluster: Cluster = "",
    json_: Json = False,
) -> None:
    """Make everything that is missing or stale, in order.

    Shows the current stage and the time left, and ends with a summary of the artifacts and their quality. Finished
    work survives an interruption: run the same command again to continue.
    """
    dataset = Dataset(root)
    dataset.recover()
    request = request_of(root, config, set_, preset=preset, defaults=defaults, only=tuple(names_of(only)))
    if dry_run:
        outcomes = list(run_pipeline(dataset, STAGES, request, force=force, dry_run=True))
        if not json_:
            print_forecast("run", outcomes, all_)
        finish("run", outcomes, json_, AFTER_DRY_RUN)
        return
    begun = time.monotonic()
    outcomes = made(dataset, request, jobs=jobs, cluster=cluster, force=force)
    if not json_:
        print_result("run", result_lines(outcomes), {}, json_)
    say(f"took {duration(time.monotonic() - begun)}")
    finish("run", outcomes, json_, f"bask-data report {quoted(root)}")


@app.command(
    epilog="""
    bask-data status data/demo
    bask-data status data/demo --all
    bask-data status data/demo --only table
    bask-data status data/demo --json
    """
)
def status(
    root: Root,
    only: Only = "",
    all_: All = False,
    config: ConfigFile = None,
    preset: Preset = None,
    set_: Set = [],  # noqa: B006
    defaults: Defaults = False,
    json_: Json = False,
) -> None:
    """Show what is up to date and what is not, and why.

    Artifacts are compared with the parameters requested when they were made, which the dataset records.
    """
    request = request_of(root, config, set_, preset=preset, defaults=defaults, only=tuple(names_of(only)))
    dataset = Dataset(root)
    found = list(standings(dataset, STAGES, request))
    rows = [
        {"stage": each.stage, "label": each.label, "status": each.state.status, "why": each.state.why} for each in found
    ]
    print_result("status", standing_lines(found, all_), {"artifacts": rows}, json_)
    is_done = all(each.state.status == "up to date" for each in found)
    if not dataset.items("recording"):
        say(f"next: bask-data ingest frames SOURCE {quoted(root)} --scene NAME ...")
    elif is_done:
        say("everything is up to date.")
    else:
        # The same options: without them `run` would make artifacts with other parameters.
        options = {"--only": only, "--config": config, "--preset": preset, "--set": set_, "--defaults": defaults}
        say(f"next: {with_options(f'bask-data run {quoted(root)}', options)}")
