"""The whole pipeline: what is up to date, and making what is not."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from pathlib import Path

from bask_data.dataset import Dataset, Variant
from bask_data.engine.declare import Stage
from bask_data.engine.making import Outcome, Position, foretold, run
from bask_data.engine.requested import Requested, RunRequest, read_requested, record_requested, variant_names
from bask_data.engine.sections import laid_over
from bask_data.engine.snapshot import Snapshot
from bask_data.engine.state import State, state_told
from bask_data.engine.tasks import Task, named_files, plan
from bask_data.errors import UsageError

Begin = Callable[[Position], None]
"""Called when something begins: a stage, or an item of it where items are made one after the other."""


@dataclass(frozen=True)
class PlannedStage:
    """Tasks of one stage in one variant."""

    stage: Stage
    variant: str
    tasks: list[Task]


@dataclass(frozen=True)
class Standing:
    """How one artifact of the pipeline stands.

    Args:
        path: where it lies or will lie.
    """

    stage: str
    label: str
    kind: str
    item: str
    variant: str
    path: Path
    state: State


def planned(dataset: Dataset, stages: Sequence[Stage], request: RunRequest) -> list[PlannedStage]:
    """All that a request is for, in the order in which each finds its inputs made. Nothing is made.

    Args:
        stages: all there are, in order.

    Raises:
        UsageError: a stage, an item, a variant, a section or a parameter is not what it may be.
        BadData: what is recorded of the dataset is not.
    """
    names = [stage.name for stage in stages]
    unknown = [name for name in request.stages if name not in names]
    if unknown:
        raise UsageError("run", "stages", expected=f"some of {', '.join(names)}", got=", ".join(unknown))
    if request.options and len(request.stages) != 1:
        raise UsageError("run", "options", expected="one stage whose they are", got=", ".join(request.stages) or "all")
    if request.only:
        dataset.select(request.only)
    recorded = read_requested(dataset.root, stages)
    if request.replaces:
        recorded = Requested(files=recorded.files)
    batches = []
    for stage in stages:
        items = _items(dataset, stage, request)
        if (request.stages and stage.name not in request.stages) or items is None:
            continue
        for variant in _variants(dataset, stage, request):
            tasks = plan(
                dataset,
                stage,
                config=laid_over(request.standing, request.given, stage.name, variant_names(dataset, stage, variant)),
                options=request.options,
                only=items,
                variant=variant,
                variant_inputs=request.variant_inputs,
                requested=recorded,
            )
            batches.append(PlannedStage(stage, variant, tasks))
    return batches


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
    """Make what is missing or stale, in order, and yield what became of each task as it comes.

    All is planned before anything is made, when this is called: a bad parameter of a late stage must not cost the time
    of the first. What was requested is recorded with the dataset once the first task of a stage came out well.

    Args:
        stages: all there are, in order; the request chooses.
        executor: where items of a stage are worked on at the same time; here, one after the other, by default.
        force: make again what is up to date.
        dry_run: make and record nothing, and say what would be made.
        begin: called with where it is when something begins.

    Raises:
        UsageError: as `planned`; or there is nothing that the stages could make anything of.
        BadData: what is recorded of the dataset is not what it may be.
    """
    request = request or RunRequest()
    batches = planned(dataset, stages, request)
    _refuse_nothing(dataset, batches, request)
    if dry_run:
        return _foretold(batches, force)
    return _made(dataset, batches, request, executor, force, begin or (lambda position: None))


def status(dataset: Dataset, stages: Sequence[Stage], request: RunRequest | None = None) -> Iterator[Standing]:
    """How every artifact stands that the request is for, in order. All are judged by one look at the disk.

    Args:
        stages: all there are, in order; the request chooses.

    Raises:
        UsageError, BadData: as `planned`, when this is called.
    """
    batches = planned(dataset, stages, request or RunRequest())

    def standings() -> Iterator[Standing]:
        seen = Snapshot()
        for batch in batches:
            for task in batch.tasks:
                kind, state = task.stage.makes.kind, state_told(task, seen)
                yield Standing(batch.stage.name, task.label, kind, task.item, task.variant, task.target, state)

    return standings()


def _refuse_nothing(dataset: Dataset, batches: Sequence[PlannedStage], request: RunRequest) -> None:
    """A run that can make nothing of what the dataset holds is most likely one of an empty dataset."""
    if not request.stages:
        dataset.select([])
    for batch in batches if request.stages else ():
        if not batch.tasks:
            dataset.select([], batch.stage.makes.scope)


def _items(dataset: Dataset, stage: Stage, request: RunRequest) -> list[str] | None:
    """Those of the chosen items that a stage has; None where it has none of them and was not asked for by name."""
    if not request.only or stage.makes.scope == "dataset":
        return []
    if request.stages:
        return list(request.only)
    there = set(dataset.items(stage.makes.scope))
    return [name for name in request.only if name in there] or None


def _variants(dataset: Dataset, stage: Stage, request: RunRequest) -> list[str]:
    if request.variant is None or not stage.makes.has_variants:
        return list(dataset.variants(stage.makes))
    return [request.variant]


def _foretold(batches: Sequence[PlannedStage], force: bool) -> Iterator[Outcome]:
    seen, coming = Snapshot(), set[Path]()
    for i_batch, batch in enumerate(batches):
        for i_task, outcome in enumerate(foretold(batch.tasks, coming, force, seen=seen)):
            yield replace(outcome, position=_position(batches, i_batch, outcome.item, i_task))


def _made(
    dataset: Dataset,
    batches: Sequence[PlannedStage],
    request: RunRequest,
    executor: Executor | None,
    force: bool,
    begin: Begin,
) -> Iterator[Outcome]:
    recorded: set[str] = set()
    for i_batch, batch in enumerate(batches):
        stage, is_listed = batch.stage, batch.variant == "main"
        for i_task, outcome in enumerate(_outcomes(batches, i_batch, executor, force, begin)):
            if outcome.status in ("made", "up to date") and stage.name not in recorded:
                files = [file for task in batch.tasks for file in named_files(stage, task.params).values()]
                items = _items(dataset, stage, request) or ()
                record_requested(dataset, stage, request, items=items, files=files)
                recorded.add(stage.name)
            if outcome.status == "made" and not is_listed:
                dataset.add_variant(stage.makes, batch.variant, _variant(dataset, batch, request))
                is_listed = True
            yield replace(outcome, position=_position(batches, i_batch, outcome.item, i_task))


def _variant(dataset: Dataset, batch: PlannedStage, request: RunRequest) -> Variant:
    """A variant as `dataset.json` will list it: with the inputs it was asked for, or those it had."""
    if request.variant is None:
        return dataset.variants(batch.stage.makes)[batch.variant]
    return Variant(inputs=request.variant_inputs)


def _outcomes(
    batches: Sequence[PlannedStage], i_batch: int, executor: Executor | None, force: bool, begin: Begin
) -> Iterator[Outcome]:
    """Of one batch; what begins is told before it is waited for."""
    tasks = batches[i_batch].tasks
    if executor is not None:
        begin(_position(batches, i_batch, "", 0))
        yield from run(tasks, executor=executor, force=force)
        return
    for i_task, task in enumerate(tasks):
        begin(_position(batches, i_batch, task.item, i_task))
        yield from run([task], force=force)


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
