"""What a run shows: current stage and time left, the outcome of each task, and a summary at the end."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from bask_data.cli.console import duration, print_result, say, show_outcome, shown_progress
from bask_data.cli.working import attributes_of, executor_of
from bask_data.dataset import Dataset
from bask_data.engine import Outcome, Position, RunRequest, Standing, run_pipeline
from bask_data.engine.forecast import Forecast
from bask_data.pipeline import STAGES

AFTER_DRY_RUN = "the same without --dry-run"

MOST_LISTED = 3
"""Artifacts of a stage that a summary lists; the others are counted."""

STATUSES = ("up to date", "would make", "may make", "stale", "missing", "blocked")
"""Statuses in the order in which a summary counts them."""


def made(dataset: Dataset, request: RunRequest, *, jobs: int, cluster: str, force: bool) -> list[Outcome]:
    """Make what is requested, and show the progress."""
    predicted = list(run_pipeline(dataset, STAGES, request, force=force, dry_run=True))
    with shown_progress(), executor_of(jobs, cluster) as (executor, n_workers):
        course = Course(Forecast(dataset.root, predicted, n_workers), is_pipeline=not request.stages)
        outcomes = run_pipeline(dataset, STAGES, request, executor=executor, force=force, begin=course.begin)
        return list(course.shown(outcomes))


class Course:
    """Shows the course of a run on stderr.

    Args:
        is_pipeline: whether all stages run; artifacts that are up to date are then counted, not listed.
    """

    def __init__(self, forecast: Forecast, is_pipeline: bool) -> None:
        self._forecast, self._is_pipeline = forecast, is_pipeline
        self._kinds = {stage.name: stage.makes.kind for stage in STAGES}
        self._begun = time.monotonic()

    def begin(self, at: Position) -> None:
        """Print what begins, unless it is known to be up to date: number of the stage, item, and time left."""
        kind = self._kinds[at.stage]
        if self._forecast.is_pending(kind, at.item):
            say(f"  {at.label}{self._left()}")

    def _left(self) -> str:
        seconds, bound = self._forecast.left()
        return f", {bound} {duration(seconds)} left" if seconds else ""

    def shown(self, outcomes: Iterable[Outcome]) -> Iterator[Outcome]:
        """The same outcomes, each shown when it arrives."""
        counted: Counter[str] = Counter()
        for outcome in outcomes:
            self._forecast.count(outcome)
            if self._is_pipeline and outcome.status == "up to date":
                counted[outcome.kind] += 1
            else:
                show_outcome(outcome)
                _show_findings(outcome)
            yield outcome
        if counted:
            say(f"  up to date  {', '.join(f'{n} {kind}' for kind, n in counted.items())}")


def _show_findings(outcome: Outcome) -> None:
    """Print the summary and the warnings of an artifact."""
    from bask_data.kinds import KINDS

    if outcome.status == "made":
        [kind] = [kind for kind in KINDS if kind.kind == outcome.kind]
        for line in kind(outcome.path).summary():
            say(f"              {line}")
    for warning in attributes_of(outcome).get("warnings", []):
        say(f"  note: {outcome.label}: {warning}")


def result_lines(outcomes: Sequence[Outcome]) -> list[str]:
    """A line per stage: what a run made, and its quality."""
    from bask_data.kinds import KINDS
    from bask_data.kinds.headlines import headline

    present = [outcome for outcome in outcomes if outcome.status in ("made", "up to date")]
    lines = []
    for kind in KINDS:
        own = [outcome for outcome in present if outcome.kind == kind.kind]
        n_made = sum(outcome.status == "made" for outcome in own)
        if own:
            counts = f"{n_made} made" + (f", {len(own) - n_made} up to date" if n_made < len(own) else "")
            quality = headline([kind(Path(outcome.path)) for outcome in own])
            lines.append(f"  {kind.kind:<16} {counts}{f';  {quality}' if quality else ''}")
    return lines


def print_forecast(command: str, outcomes: Sequence[Outcome], every: bool) -> None:
    """Print what a dry run would make."""
    rows = [(outcome.position.stage if outcome.position else command, outcome) for outcome in outcomes]
    print_result(command, summary([(stage, o.label, o.status, o.why) for stage, o in rows], every), {}, False)


def standing_lines(standings: Sequence[Standing], every: bool) -> list[str]:
    """Lines that show what is up to date and what is not."""
    return summary([(each.stage, each.label, each.state.status, each.state.why) for each in standings], every)


def summary(rows: Sequence[tuple[str, str, str, str]], every: bool) -> list[str]:
    """Lines for (stage, label, status, why): each, or counts per stage and the first that are not up to date."""
    if every:
        return [_line(label, status, why) for _, label, status, why in rows]
    lines = []
    for stage in dict.fromkeys(row[0] for row in rows):
        own = [row for row in rows if row[0] == stage]
        counts = Counter(status for _, _, status, _ in own)
        lines.append(
            f"  {stage:<16} {', '.join(f'{counts[status]} {status}' for status in STATUSES if counts[status])}"
        )
        others = [row for row in own if row[2] != "up to date"]
        lines += [f"  {_line(label, status, why)}" for _, label, status, why in others[:MOST_LISTED]]
        if len(others) > MOST_LISTED:
            lines.append(f"    ... and {len(others) - MOST_LISTED} more; --all lists them")
    return lines


def _line(label: str, status: str, why: str) -> str:
    return f"  {status:<10}  {label}{f'  ({why})' if why else ''}"
