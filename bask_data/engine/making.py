"""Making artifacts: one task, or many in this process or on an executor."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, as_completed
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, cast

from bask_data.artifact import Manifest, digest_of, read_manifest
from bask_data.dataset import write_groups_above
from bask_data.engine.arguments import arguments_of
from bask_data.engine.publishing import Origin, published, scratches
from bask_data.engine.resumable import filled_resumable
from bask_data.engine.snapshot import Live, Snapshot
from bask_data.engine.state import Blocked, State, key_parts, state_of, state_or_blocked
from bask_data.engine.tasks import Task, parameter_files
from bask_data.errors import BaskError
from bask_data.progress import report
from bask_data.spelling import choices


@dataclass(frozen=True)
class Position:
    """Position in a run of several stages.

    Args:
        stage_number: from 1 to `n_stages`; a stage that makes several variants counts once for each.
        item: empty for artifacts of the dataset, and when several items are processed in parallel.
        item_number: from 1 to `n_items`; for an outcome, the number of outcomes so far.
    """

    stage: str
    variant: str
    stage_number: int
    n_stages: int
    item: str
    item_number: int
    n_items: int

    @property
    def label(self) -> str:
        """The position in words: `stage 3 of 7: masks table1 (1 of 4)`, without what there is only one of."""
        stages = f"stage {self.stage_number} of {self.n_stages}: " if self.n_stages > 1 else ""
        variant = "" if self.variant == "main" else f" {self.variant}"
        if self.item:
            items = f" {self.item}" + (f" ({self.item_number} of {self.n_items})" if self.n_items > 1 else "")
        else:
            items = f" ({self.n_items} items)" if self.n_items > 1 else ""
        return f"{stages}{self.stage}{variant}{items}"


@dataclass(frozen=True)
class Outcome:
    """The outcome of a task.

    Args:
        status: in a dry run `would make`, or `may make` if it depends on whether remade inputs change.
        why: in words, why the artifact was made or not; for `up to date` which of its files are missing here, if any.
        seconds: duration of the work.
        digest: content digest of the artifact, if there is one.
        error: the cause of a failure, if it is a `BaskError`.
        blocked: the reason for the status `blocked`.
        position: in a run of several stages.
    """

    label: str
    kind: str
    item: str
    variant: str
    path: str
    status: Literal["made", "up to date", "failed", "blocked", "would make", "may make"]
    why: str = ""
    seconds: float = 0.0
    digest: str = ""
    error: BaskError | None = None
    blocked: Blocked | None = None
    position: Position | None = None


def make(task: Task, force: bool = False, *, publishing: Callable[[], None] = lambda: None) -> Outcome:
    """Make one artifact unless it is up to date. Errors are returned in the outcome, so that other items continue.

    Args:
        publishing: called when the artifact is complete, before it takes its place.
    """
    begun = time.perf_counter()
    path = str(task.target)
    outcome = Outcome(task.label, task.stage.makes.kind, task.item, task.variant, path, "made")
    try:
        state = state_of(task)
        if state.status == "blocked":
            return replace(outcome, status="blocked", why=state.why, blocked=state.blocked)
        if state.status == "up to date" and not force:
            return replace(outcome, status="up to date", why=state.why, digest=read_manifest(task.target).digest)
        manifest = _make(task, begun, force, publishing)
    except BaskError as error:
        return replace(
            outcome, status="failed", why=_with_notes(error), seconds=time.perf_counter() - begun, error=error
        )
    except ImportError:
        raise
    except Exception as error:
        # An unexpected input, or a full disk: other items continue, and the message names this one.
        if os.environ.get("BASK_DEBUG"):
            raise
        why = f"{path}: {type(error).__name__}: {error}  fix: `bask-data validate`, or BASK_DEBUG=1 for the traceback."
        return replace(outcome, status="failed", why=why, seconds=time.perf_counter() - begun)
    return replace(outcome, seconds=time.perf_counter() - begun, digest=manifest.digest, why=state.why)


def _with_notes(error: BaskError) -> str:
    return "\n".join([str(error), *getattr(error, "__notes__", [])])


def _make(task: Task, begun: float, force: bool, publishing: Callable[[], None]) -> Manifest:
    parameter_files(task)  # The recorded digest of an absent file is enough for a key, but not for making anything.
    parts = key_parts(task)
    makes, key = task.stage.makes, digest_of(parts)
    origin = Origin(task.stage.name, task.stage.version, parts["params"], parts["inputs"], key)
    arguments = arguments_of(task)
    write_groups_above(task.root, makes, task.variant)

    def fill(scratch: Path) -> Manifest:
        task.stage.function(**arguments, out=scratch)
        publishing()
        return published(task.root, task.target, scratch, artifact=makes, origin=origin, begun=begun)

    if task.stage.resumable:
        return filled_resumable(task, key, fill, force)
    with scratches(task.root, [makes]) as written:
        return fill(written[makes])


def predicted(
    tasks: Sequence[Task], coming: set[Path], force: bool = False, *, seen: Live | None = None
) -> Iterator[Outcome]:
    """The outcomes of a dry run: what `run` would make, and why.

    Args:
        coming: paths of what earlier stages would or may make; those of these tasks are added.
        seen: the artifacts on disk; by default a new snapshot.
    """
    seen = seen or Snapshot()
    for task in tasks:
        state = state_or_blocked(task, seen)
        missing = state.blocked.paths if state.blocked else ()
        if missing and coming.issuperset(missing):
            state = State("missing", f"after {choices(path.relative_to(task.root).as_posix() for path in missing)}")
        status = cast(Any, state.status)
        remade = [binding.place for binding in task.bindings if task.root / binding.place in coming]
        if status in ("missing", "stale") or (force and status == "up to date"):
            status = "would make"
        elif status == "up to date" and remade:
            # It stays as it is if its inputs turn out the same again.
            status, state = "may make", State("up to date", f"if this changes: {choices(remade)}")
        if status in ("would make", "may make"):
            coming.add(task.target)
        yield Outcome(
            task.label,
            task.stage.makes.kind,
            task.item,
            task.variant,
            str(task.target),
            status,
            state.why,
            blocked=state.blocked,
        )


def run(tasks: Sequence[Task], *, executor: Executor | None = None, force: bool = False) -> Iterator[Outcome]:
    """Make what is not up to date, in this process or on an executor, and yield outcomes as they arrive."""
    if executor is None:
        for task in tasks:
            yield make(task, force)
        return
    futures = [executor.submit(make, task, force) for task in tasks]
    label = tasks[0].stage.name if tasks else ""
    try:
        for done, future in enumerate(as_completed(futures), start=1):
            report(label, done, len(futures))
            yield future.result()
    except BaseException:
        for future in futures:
            future.cancel()
        raise
