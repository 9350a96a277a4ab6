"""The whole pipeline: the state of its artifacts, and making those that are not up to date."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from bask_data.artifact import MANIFEST
from bask_data.dataset import Dataset, Variant
from bask_data.engine.declare import Stage
from bask_data.engine.making import Outcome, Position, make, predicted, run
from bask_data.engine.params_file import own_parameters
from bask_data.engine.requested import (
    REQUESTED,
    Requested,
    RunRequest,
    read_requested,
    record_requested,
    under_and_over_record,
    variant_names,
)
from bask_data.engine.sections import Config, laid_over, of_stage
from bask_data.engine.snapshot import Snapshot
from bask_data.engine.state import State, state_or_blocked
from bask_data.engine.tasks import Task, named_files, plan
from bask_data.errors import UsageError
from bask_data.progress import note

Begin = Callable[[Position], None]
"""Called at the beginning of a stage, or of each item if items are made one after the other."""


@dataclass(frozen=True)
class PlannedStage:
    """The tasks of one stage for one variant."""

    stage: Stage
    variant: str
    tasks: list[Task]


@dataclass(frozen=True)
class Standing:
    """An artifact of the pipeline and its state.

    Args:
        path: where the artifact is or will be.
    """

    stage: str
    label: str
    kind: str
    item: str
    variant: str
    path: Path
    state: State


def planned(dataset: Dataset, stages: Sequence[Stage], request: RunRequest) -> list[PlannedStage]:
    """The tasks of a request, ordered so that inputs come first. Nothing is made.

    Args:
        stages: all stages of the pipeline, in order.

    Raises:
        UsageError: a stage, item, variant, section or parameter is unknown or invalid.
        BadData: the dataset's params.yaml, or its record of parameters, is invalid.
    """
    names = [stage.name for stage in stages]
    unknown = [name for name in request.stages if name not in names]
    if unknown:
        raise UsageError("run", "stages", expected=f"some of {', '.join(names)}", got=", ".join(unknown))
    if request.options and len(request.stages) != 1:
        raise UsageError(
            "run", "options", expected="exactly one stage with options", got=", ".join(request.stages) or "all"
        )
    for stage in stages:
        if stage.name in request.stages and request.variant not in (None, "main") and not stage.makes.has_variants:
            having = ", ".join(other.name for other in stages if other.makes.has_variants)
            fix = f"variants are made by {having}."
            raise UsageError(stage.name, "variant", expected="no variant", got=request.variant, fix=fix)
    if request.only:
        dataset.select(request.only)
    own = {} if request.ignores_own_file else own_parameters(dataset.root, stages)
    requested = read_requested(dataset.root)
    _note_unknown_sections(requested, names)
    if request.replaces:
        requested = Requested(files=requested.files)
    older, newer = under_and_over_record(own, requested)
    batches = []
    for stage in stages:
        items = _items(dataset, stage, request)
        if (request.stages and stage.name not in request.stages) or items is None:
            continue
        for variant in _variants(dataset, stage, request):
            names = variant_names(dataset, stage, variant)
            recorded = laid_over(older, requested.parameters, stage.name, names)
            tasks = plan(
                dataset,
                stage,
                config=laid_over(newer, request.given, stage.name, names),
                options=request.options,
                only=items,
                variant=variant,
                variant_inputs=request.variant_inputs,
                requested=Requested(parameters=recorded, files=requested.files),
            )
            if stage.on_request and stage.name not in request.stages:
                tasks = [task for task in tasks if (task.target / MANIFEST).exists()]
                if not tasks:
                    continue
            batches.append(PlannedStage(stage, variant, tasks))
    return batches


def _note_unknown_sections(requested: Requested, stages: Sequence[str]) -> None:
    unknown = [section for section in requested.parameters if section.partition("@")[0] not in stages]
    if unknown:
        note(f"{REQUESTED}: no stage has these sections, which are ignored: {', '.join(unknown)}")


def run_pipeline(
    dataset: Dataset,
    stages: Sequence[Stage],
    request: RunRequest | None = None,
    *,
    executor: Executor | None = None,
    force: bool = False,
    dry_run: bool = False,
    begin: Begin | None = None,
) -> Iterator[Outcome]:
    """Make what is missing or stale, in order, and yield the outcome of each task as it arrives.

    The call plans everything before anything is made: an invalid parameter of a late stage must not cost the time of
    the first. The requested parameters of a stage are recorded with the dataset after its first successful task; if all
    stages were requested, also those of a stage that has nothing to process yet.

    Args:
        stages: all stages of the pipeline, in order; the request selects from them.
        executor: processes items of a stage in parallel; by default they are made one after the other, in this process.
        force: also make what is up to date.
        dry_run: make and record nothing, and yield what would be made.
        begin: called with the position at each beginning.

    Raises:
        UsageError: as for `planned`; or the dataset has no recordings that the stages could work on.
        BadData: the parameters recorded with the dataset are invalid.
    """
    request = request or RunRequest()
    batches = planned(dataset, stages, request)
    _refuse_nothing(dataset, batches, request)
    if dry_run:
        return _predicted(batches, force)
    # Read here, not when something is recorded: the file may be edited during a run, and that is a newer statement.
    own = own_parameters(dataset.root, stages)
    return _made(dataset, batches, request, own, executor, force, begin or (lambda position: None))


def status(dataset: Dataset, stages: Sequence[Stage], request: RunRequest | None = None) -> Iterator[Standing]:
    """The state of every artifact of a request, in order, from one snapshot of the disk.

    Args:
        stages: all stages of the pipeline, in order; the request selects from them.

    Raises:
        UsageError, BadData: as for `planned`, at the call.
    """
    batches = planned(dataset, stages, request or RunRequest())

    def standings() -> Iterator[Standing]:
        seen = Snapshot()
        for batch in batches:
            for task in batch.tasks:
                kind, state = task.stage.makes.kind, state_or_blocked(task, seen)
                yield Standing(batch.stage.name, task.label, kind, task.item, task.variant, task.target, state)

    return standings()


def _refuse_nothing(dataset: Dataset, batches: Sequence[PlannedStage], request: RunRequest) -> None:
    """`UsageError` for a run without any item to process: the dataset is most likely empty."""
    if not request.stages:
        dataset.select([])
    for batch in batches if request.stages else ():
        if not batch.tasks:
            dataset.select([], batch.stage.makes.scope)


def _items(dataset: Dataset, stage: Stage, request: RunRequest) -> list[str] | None:
    """The requested items in the stage's scope; None if there are none and the stage was not requested by name."""
    if not request.only or stage.makes.scope == "dataset":
        return []
    if request.stages:
        return list(request.only)
    in_scope = set(dataset.items(stage.makes.scope))
    return [name for name in request.only if name in in_scope] or None


def _variants(dataset: Dataset, stage: Stage, request: RunRequest) -> list[str]:
    if request.variant is None or not stage.makes.has_variants:
        return list(dataset.variants(stage.makes))
    return [request.variant]


def _predicted(batches: Sequence[PlannedStage], force: bool) -> Iterator[Outcome]:
    seen, coming = Snapshot(), set[Path]()
    for i_batch, batch in enumerate(batches):
        for i_task, outcome in enumerate(predicted(batch.tasks, coming, force, seen=seen)):
            yield replace(outcome, position=_position(batches, i_batch, outcome.item, i_task))


def _made(
    dataset: Dataset,
    batches: Sequence[PlannedStage],
    request: RunRequest,
    own: Config,
    executor: Executor | None,
    force: bool,
    begin: Begin,
) -> Iterator[Outcome]:
    recorded, failed = set[str](), set[str]()

    def record(stage: Stage) -> None:
        if stage.name not in recorded:
            _record(dataset, batches, stage, request, own)
            recorded.add(stage.name)

    for i_batch, batch in enumerate(batches):
        stage, is_listed = batch.stage, batch.variant == "main"
        # Before the first artifact is published: after a kill between the two it would be stale for everyone.
        outcomes = _outcomes(batches, i_batch, executor, force, begin, partial(record, stage))
        for i_task, outcome in enumerate(outcomes):
            if outcome.status in ("made", "up to date"):
                record(stage)
            if outcome.status == "failed":
                failed.add(stage.name)
            if outcome.status == "made" and not is_listed:
                dataset.add_variant(stage.makes, batch.variant, _variant(dataset, batch, request))
                is_listed = True
            yield replace(outcome, position=_position(batches, i_batch, outcome.item, i_task))
        is_last = all(later.stage is not stage for later in batches[i_batch + 1 :])
        if is_last and stage.name not in recorded:
            if request.stages or stage.name in failed:
                _note_unrecorded(stage, request)
            else:
                # What it reads is missing, or there is no item yet: the parameters are for when there is.
                record(stage)


def _note_unrecorded(stage: Stage, request: RunRequest) -> None:
    if request.options or of_stage(request.given, stage.name):
        note(f"{stage.name}: its parameters are not recorded with the dataset, because nothing was made with them")


def _record(dataset: Dataset, batches: Sequence[PlannedStage], stage: Stage, request: RunRequest, own: Config) -> None:
    """Record the requested parameters of a stage, for all variants of the run."""
    tasks = [task for batch in batches if batch.stage is stage for task in batch.tasks]
    files = {file for task in tasks for file in named_files(stage, task.params).values()}
    record_requested(dataset, stage, request, own, items=_items(dataset, stage, request) or (), files=files)


def _variant(dataset: Dataset, batch: PlannedStage, request: RunRequest) -> Variant:
    """A variant for `dataset.json`: with the requested inputs, or those already listed."""
    if request.variant is None:
        return dataset.variants(batch.stage.makes)[batch.variant]
    return Variant(inputs=request.variant_inputs)


def _outcomes(
    batches: Sequence[PlannedStage],
    i_batch: int,
    executor: Executor | None,
    force: bool,
    begin: Begin,
    publishing: Callable[[], None],
) -> Iterator[Outcome]:
    """Outcomes of one batch; `begin` is called before the work starts, `publishing` as by `make` if it is done here."""
    tasks = batches[i_batch].tasks
    if executor is not None:
        begin(_position(batches, i_batch, "", 0))
        yield from run(tasks, executor=executor, force=force)
        return
    for i_task, task in enumerate(tasks):
        begin(_position(batches, i_batch, task.item, i_task))
        yield make(task, force, publishing=publishing)


def _position(batches: Sequence[PlannedStage], i_batch: int, item: str, i_task: int) -> Position:
    batch = batches[i_batch]
    return Position(
        stage=batch.stage.name,
        variant=batch.variant,
        stage_number=i_batch + 1,
        n_stages=len(batches),
        item=item,
        item_number=i_task + 1,
        n_items=len(batch.tasks),
    )
