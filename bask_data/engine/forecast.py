"""Time left of a run, estimated from its own tasks so far, or else from the provenance of earlier ones."""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import mean
from typing import Literal

from bask_data.engine.making import Outcome

MOST_RECORDS = 5
"""Provenance records read per stage: durations vary more between stages than between items, and a dataset may have
thousands of items."""


Bound = Literal["about", "at most", "more than"]


@dataclass
class Forecast:
    """Estimate of the time left of a run.

    Args:
        root: the dataset's directory.
        predicted: outcomes of a dry run; only tasks that would or may make something take time.
        workers: number of tasks of a stage that run in parallel.
    """

    root: Path
    predicted: Sequence[Outcome]
    workers: int = 1
    _left: dict[str, set[str]] = field(init=False)
    _uncertain: set[str] = field(init=False)
    _n_left: Counter[tuple[str, str]] = field(init=False)
    _made: dict[str, tuple[int, float]] = field(init=False)
    _recorded: dict[str, float | None] = field(init=False)

    def __post_init__(self) -> None:
        self._uncertain = set()
        # Sums and counts: each of thousands of tasks asks for what is left.
        self._left, self._n_left, self._made, self._recorded = defaultdict(set), Counter(), {}, {}
        for outcome in self.predicted:
            if outcome.status in ("would make", "may make"):
                self._left[outcome.kind].add(outcome.path)
                self._n_left[outcome.kind, outcome.item] += 1
            if outcome.status == "may make":
                self._uncertain.add(outcome.path)

    def count(self, outcome: Outcome) -> None:
        """Count one task as done."""
        if outcome.path in self._left[outcome.kind]:
            self._left[outcome.kind].remove(outcome.path)
            self._uncertain.discard(outcome.path)
            self._n_left[outcome.kind, outcome.item] -= 1
        if outcome.status == "made":
            n, seconds = self._made.get(outcome.kind, (0, 0.0))
            self._made[outcome.kind] = n + 1, seconds + outcome.seconds

    def is_pending(self, kind: str, item: str = "") -> bool:
        """Whether artifacts of a kind are, or may be, still to be made; only those of `item`, if given."""
        return self._n_left[kind, item] > 0 if item else bool(self._left[kind])

    def left(self) -> tuple[float, Bound]:
        """Seconds left, and in which sense: the duration of some stages may be unknown, and some work unnecessary."""
        total, is_all = 0.0, True
        for kind, paths in self._left.items():
            if not paths:
                continue
            n, seconds = self._made.get(kind, (0, 0.0))
            per_task = seconds / n if n else self._recorded_mean(kind)
            total += len(paths) / min(self.workers, len(paths)) * (per_task or 0.0)
            is_all = is_all and per_task is not None
        if self._uncertain:
            return total, "at most" if is_all else "about"
        return total, "about" if is_all else "more than"

    def _recorded_mean(self, kind: str) -> float | None:
        """Mean duration of earlier tasks of a kind, seconds; None if there is no record."""
        if kind not in self._recorded:
            seconds: list[float] = []
            for outcome in self.predicted:
                if outcome.kind == kind and len(seconds) < MOST_RECORDS:
                    seconds += self._recorded_seconds(Path(outcome.path))
            self._recorded[kind] = mean(seconds) if seconds else None
        return self._recorded[kind]

    def _recorded_seconds(self, target: Path) -> list[float]:
        relative = target.relative_to(self.root)
        try:
            file = self.root / "provenance" / relative.parent / f"{relative.name}.json"
            return [float(json.loads(file.read_text())["seconds"])]
        except (OSError, ValueError, KeyError, TypeError):
            return []  # Provenance is not validated: a damaged record counts as none.
