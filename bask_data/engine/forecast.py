"""How long a run still takes: by what its own tasks took, or else by what is recorded of earlier ones."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import mean

from bask_data.engine.making import Outcome

MOST_RECORDS = 5
"""Records of earlier work that are read of each stage: what an item takes varies more between stages than between
items, and a dataset may have thousands."""


@dataclass
class Forecast:
    """What is left of a run.

    Args:
        root: of the dataset.
        foreseen: what a dry run says would be made; the rest costs next to nothing.
        workers: tasks of one stage that are worked on at the same time.
    """

    root: Path
    foreseen: Sequence[Outcome]
    workers: int = 1
    _left: dict[str, set[str]] = field(init=False)
    _seconds: dict[str, list[float]] = field(init=False)
    _recorded: dict[str, float | None] = field(init=False)

    def __post_init__(self) -> None:
        self._left, self._seconds, self._recorded = defaultdict(set), defaultdict(list), {}
        for outcome in self.foreseen:
            if outcome.status == "would make":
                self._left[outcome.kind].add(outcome.path)

    def came(self, outcome: Outcome) -> None:
        """Count one task as done."""
        self._left[outcome.kind].discard(outcome.path)
        if outcome.status == "made":
            self._seconds[outcome.kind].append(outcome.seconds)

    def is_awaited(self, kind: str, item: str = "") -> bool:
        """Whether a stage still has something to make; of one item, if one is named."""
        return any(not item or Path(path).name == item for path in self._left[kind])

    def left(self) -> tuple[float, bool]:
        """Seconds, and whether all that is left is in them: what a stage takes may not be known yet."""
        total, is_all = 0.0, True
        for kind, paths in self._left.items():
            if not paths:
                continue
            each = mean(self._seconds[kind]) if self._seconds[kind] else self._of_records(kind)
            total += len(paths) / min(self.workers, len(paths)) * (each or 0.0)
            is_all = is_all and each is not None
        return total, is_all

    def _of_records(self, kind: str) -> float | None:
        """Mean of what artifacts of a kind took before; None if nothing is recorded."""
        if kind not in self._recorded:
            found: list[float] = []
            for outcome in self.foreseen:
                if outcome.kind == kind and len(found) < MOST_RECORDS:
                    found += self._record(Path(outcome.path))
            self._recorded[kind] = mean(found) if found else None
        return self._recorded[kind]

    def _record(self, target: Path) -> list[float]:
        relative = target.relative_to(self.root)
        try:
            file = self.root / "provenance" / relative.parent / f"{relative.name}.json"
            return [float(json.loads(file.read_text())["seconds"])]
        except (OSError, ValueError, KeyError, TypeError):
            return []  # A record is no part of the dataset: without a sound one, nothing is known.
