"""Shared by commands that make artifacts: the request, the workers, and the final messages."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import typer

from bask_data.cli.console import print_result, say
from bask_data.config import load_config
from bask_data.engine import PARAMS, Outcome, RunRequest
from bask_data.errors import UsageError, imported
from bask_data.pipeline import STAGES
from bask_data.presets import PresetName


@contextmanager
def executor_of(jobs: int, cluster: str) -> Iterator[tuple[Executor | None, int]]:
    """Where items are processed, and how many at once: None for this process, a pool of processes, or a Dask cluster.

    A cluster may change while it is used; its number is that of the threads of its present workers.
    """
    if cluster:
        with imported("distributed", "Dask", user="--cluster", extra="cluster").Client(cluster) as client:
            yield client.get_executor(), max(sum(client.nthreads().values()), 1)
    elif jobs > 1:
        from concurrent.futures import ProcessPoolExecutor
        from multiprocessing import get_context

        # Open3D and torch keep threads: a forked child would inherit their locks.
        with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
            try:
                yield pool, jobs
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                raise
    else:
        yield None, 1


def quoted(path: Path) -> str:
    """A path quoted for a shell."""
    return shlex.quote(str(path))


def with_options(command: str, options: Mapping[str, Any]) -> str:
    """A command with those of its options that are set, quoted for a shell.

    Args:
        options: values by flag; true for a flag alone, a list for a flag that is repeated.
    """
    words = [command]
    for flag, value in options.items():
        if value is True:
            words.append(flag)
        elif value:
            words += [f"{flag} {shlex.quote(str(each))}" for each in (value if isinstance(value, list) else [value])]
    return " ".join(words)


def request_of(
    root: Path,
    config: Path | None,
    assignments: Sequence[str],
    *,
    preset: PresetName | None = None,
    defaults: bool = False,
    **fields: Any,
) -> RunRequest:
    """A request with the parameters from a file, a preset and `--set`.

    Args:
        config: the dataset's own params.yaml is the same as None: it is used anyway.
        defaults: ignore the parameters recorded with the dataset.
        fields: further fields of the request.
    """
    own = root / PARAMS
    if config is not None and own.exists() and config.resolve() == own.resolve():
        config = None
    return RunRequest(
        given=load_config(config, assignments, STAGES, preset),
        replaces=defaults or config is not None,
        ignores_own_file=config is not None,
        **fields,
    )


def finish(command: str, outcomes: Sequence[Outcome], as_json: bool, next_command: str = "", **more: Any) -> None:
    """Print the outcomes as JSON, if requested, then the totals; exit with the code of the first failure."""
    if as_json:
        rows = [
            {
                key: getattr(outcome, key)
                for key in ("label", "kind", "item", "variant", "path", "status", "why", "seconds", "digest")
            }
            | {"metadata": attributes_of(outcome)}
            for outcome in outcomes
        ]
        print_result(command, [], {"outcomes": rows, **more}, as_json)
    failed = [outcome for outcome in outcomes if outcome.status == "failed"]
    blocked = [outcome for outcome in outcomes if outcome.status == "blocked"]
    if failed:
        say(f"{len(failed)} failed, {len(blocked)} blocked, {len(outcomes) - len(failed) - len(blocked)} succeeded.")
        raise typer.Exit(failed[0].error.exit_code if failed[0].error else 1)
    if blocked:
        # A missing recording comes first: it is the cause of missing artifacts.
        reasons = sorted((o.blocked for o in blocked if o.blocked), key=lambda reason: reason.kind != "no items")
        say(f"{len(blocked)} blocked: an input is missing.  fix: {reasons[0].fix}")
        raise typer.Exit(UsageError.exit_code)
    if next_command:
        say(f"next: {next_command}")


def attributes_of(outcome: Outcome) -> dict[str, Any]:
    """The metadata stored in the artifact; empty if there is none."""
    if outcome.status not in ("made", "up to date") or not outcome.path:
        return {}
    from bask_data.artifact import Artifact

    return Artifact(outcome.path).attributes
