"""Commands over the whole pipeline: `run` and `status`."""

from __future__ import annotations

from pathlib import Path

from bask_data.cli.commands import CommandList
from bask_data.cli.console import print_result, say, show_outcome, shown_progress
from bask_data.cli.options import Cluster, ConfigFile, DryRun, Force, Jobs, Json, Only, Preset, Root, Set
from bask_data.cli.working import (
    AFTER_DRY_RUN,
    chosen_recordings,
    executor_of,
    finish,
    parameters_of,
    quoted,
    show_findings,
)
from bask_data.dataset import Dataset
from bask_data.engine import Outcome, State, foretold, plan, run, state_told
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
    config: ConfigFile = None,
    preset: Preset = None,
    set_: Set = [],  # noqa: B006  # Typer copies it.
    jobs: Jobs = 1,
    cluster: Cluster = "",
    json_: Json = False,
) -> None:
    """Make everything that is missing or stale, in order."""
    dataset = Dataset(root)
    dataset.recover()
    parameters = parameters_of(root, config, set_, preset)
    chosen = chosen_recordings(dataset, only)
    names = chosen if only else []
    planned = []
    for stage in STAGES:
        items = [name for name in names if name in dataset.items(stage.makes.scope)]
        if names and stage.makes.scope != "dataset" and not items:
            continue
        for variant in dataset.variants(stage.makes):
            planned.append(plan(dataset, stage, config=parameters, only=items, variant=variant))
    # All are planned before any is made: a bad parameter of a late stage must not cost the time of the first.
    outcomes: list[Outcome] = []
    coming: set[Path] = set()
    with shown_progress(), executor_of(jobs, cluster) as executor:
        for tasks in planned:
            for outcome in foretold(tasks, coming, force) if dry_run else run(tasks, executor=executor, force=force):
                show_outcome(outcome)
                show_findings(outcome)
                outcomes.append(outcome)
    finish("run", outcomes, json_, AFTER_DRY_RUN if dry_run else f"bask-data report {quoted(root)}")


@app.command(
    epilog="""
    bask-data status data/demo
    bask-data status data/demo --json
    """
)
def status(
    root: Root,
    config: ConfigFile = None,
    preset: Preset = None,
    set_: Set = [],  # noqa: B006
    json_: Json = False,
) -> None:
    """Say what is up to date, and of what is not, why."""
    dataset = Dataset(root)
    parameters = parameters_of(root, config, set_, preset)
    rows: list[tuple[str, str, State]] = []
    for stage in STAGES:
        for variant in dataset.variants(stage.makes):
            for task in plan(dataset, stage, config=parameters, variant=variant):
                rows.append((stage.name, task.label, state_told(task)))
    lines = [f"  {state.status:<10}  {label}{f'  ({state.why})' if state.why else ''}" for _, label, state in rows]
    found = [{"stage": stage, "label": label, "status": state.status, "why": state.why} for stage, label, state in rows]
    print_result("status", lines, {"artifacts": found}, json_)
    n_todo = sum(state.status != "up to date" for _, _, state in rows)
    say(f"next: bask-data run {quoted(root)}" if n_todo else "everything is up to date.")
