"""Stages run from Python: what is asked for, how it goes, and what came of it."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from textwrap import shorten
from typing import Any

from bask_data.dataset import Dataset
from bask_data.engine import Outcome, Position, RunRequest, Stage, Standing, run_pipeline, status
from bask_data.errors import BaskError, UsageError
from bask_data.notebook.html import table_html
from bask_data.pipeline import STAGES
from bask_data.progress import Pace, listened_by
from bask_data.spelling import suggestion

WHY_WIDTH = 100
"""Characters of a reason in a line of text; a table in a notebook wraps, and has all of it."""
SECONDS_BETWEEN = 0.2
"""Of progress in place: each update is a message to the browser."""


class Standings(tuple[Standing, ...]):
    """How the artifacts stand, a line or a row of a table each."""

    def __repr__(self) -> str:
        lines = [_line(one.state.status, one.label, one.state.why) for one in self]
        return "\n".join(lines) or "nothing to make: the dataset has no recordings"

    def _repr_html_(self) -> str:
        rows = [(one.stage, one.item, one.variant, one.state.status, one.state.why, _fix(one)) for one in self]
        return table_html(("stage", "item", "variant", "status", "why", "fix"), rows)


class Outcomes(tuple[Outcome, ...]):
    """What came of the tasks of a run, a line or a row of a table each."""

    def __repr__(self) -> str:
        return "\n".join(_line(one.status, f"{one.label} {_seconds(one)}".rstrip(), one.why) for one in self)

    def _repr_html_(self) -> str:
        rows = [(one.label, one.variant, one.status, _seconds(one), one.why) for one in self]
        return table_html(("task", "variant", "status", "time", "why"), rows)


def standings_of(dataset: Dataset, stages: str | Sequence[str], only: str | Sequence[str]) -> Standings:
    """How everything stands, or what some stages make of some recordings.

    Raises:
        UsageError: there is no such stage or recording.
    """
    chosen = tuple(stage_named(dataset, name).name for name in _names(stages))
    return Standings(status(dataset, STAGES, RunRequest(stages=chosen, only=_names(only))))


def made(
    dataset: Dataset, stage: str, only: str | Sequence[str], variant: str, force: bool, params: dict[str, Any]
) -> Outcomes:
    """Make what one stage or all have to make, as the commands do, and show how it goes on stderr.

    Args:
        stage: its name; empty for all, with every variant that the dataset lists.
        params: of the one stage; or `descriptor="big"`, the variant of an input that has some.

    Raises:
        UsageError: there is no such stage, recording or parameter, or an input is missing.
        BaskError: what the first task that failed raised, after the others.
    """
    if not stage and (params or variant != "main"):
        got, fix = f"{', '.join(params) or 'variant'} without a stage", 'ds.run("reconstruct", voxel_size=0.01)'
        raise UsageError(dataset.root, "run", expected="parameters or a variant of a named stage", got=got, fix=fix)
    inputs = stage_named(dataset, stage).inputs if stage else ()
    with_variants = {given.artifact.kind for given in inputs if given.artifact.has_variants}
    request = RunRequest(
        stages=_names(stage),
        only=_names(only),
        variant=variant if stage else None,
        variant_inputs={name: value for name, value in params.items() if name in with_variants},
        options={name: value for name, value in params.items() if name not in with_variants},
    )
    dataset.recover()
    shown = _Shown()
    with listened_by(shown):
        outcomes = []
        for outcome in run_pipeline(dataset, STAGES, request, force=force, begin=shown.begin):
            outcomes.append(outcome)
            shown.line(_line(outcome.status, f"{outcome.label} {_seconds(outcome)}".rstrip(), outcome.why))
    for outcome in outcomes:
        if outcome.status == "failed":
            raise outcome.error or BaskError(outcome.path, expected="to be made", got=outcome.why)
    for outcome in outcomes:
        if outcome.blocked:
            fix = outcome.blocked.fix
            raise UsageError(dataset.root, outcome.label, expected="its inputs", got=outcome.why, fix=fix)
    return Outcomes(outcomes)


def stage_named(dataset: Dataset, name: str) -> Stage:
    """The stage of that name.

    Raises:
        UsageError: there is none.
    """
    stages = {stage.name: stage for stage in STAGES}
    if name not in stages:
        fix = suggestion(str(name), stages)
        raise UsageError(dataset.root, "stage", expected=f"one of {', '.join(stages)}", got=name, fix=fix)
    return stages[name]


class _Shown:
    """The course of a run on stderr: lines, and below them the loop that runs, where a line can be written over."""

    def __init__(self) -> None:
        self._is_live = sys.stderr.isatty() or "ipykernel" in sys.modules
        self._width, self._last, self._pace = 0, 0.0, Pace()

    def begin(self, at: Position) -> None:
        """Say what begins, where there are several."""
        if max(at.n_items, at.n_stages) > 1 and self._is_live:
            self._over(at.label)

    def __call__(self, label: str, done: int, total: int | None) -> None:
        now, seconds = time.monotonic(), self._pace.seconds_left(label, done, total)
        if self._is_live and now - self._last >= SECONDS_BETWEEN:
            self._last = now
            left = "" if seconds is None else f", {seconds:.0f} s left"
            self._over(f"{label} {done}{f'/{total}' if total else ''}{left}")

    def line(self, text: str) -> None:
        """A line that stays."""
        self._over("")
        print(text, file=sys.stderr, flush=True)

    def _over(self, text: str) -> None:
        """Write over the line that goes on; nothing is left of a longer one."""
        if self._is_live:
            print(f"\r{text:<{self._width}}" + ("" if text else "\r"), end="", file=sys.stderr, flush=True)
            self._width = len(text)


def _names(names: str | Sequence[str]) -> tuple[str, ...]:
    return (names,) if isinstance(names, str) and names else tuple(names)


def _line(status: str, label: str, why: str) -> str:
    reason = shorten(why, WHY_WIDTH, placeholder=" ...")
    return f"{status:<10}  {label}{f'  ({reason})' if reason else ''}"


def _seconds(outcome: Outcome) -> str:
    return f"{outcome.seconds:.1f} s" if outcome.seconds >= 0.05 else ""


def _fix(standing: Standing) -> str:
    return standing.state.blocked.fix if standing.state.blocked else ""
