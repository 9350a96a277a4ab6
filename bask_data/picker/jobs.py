"""Long work for the page: one job at a time, how far it is, and a way to end it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from bask_data.errors import UsageError
from bask_data.progress import listened_by


class Cancelled(Exception):
    """The job was cancelled; raised where it reports its progress."""


@dataclass
class _Job:
    """What runs, since when, and how far its present loop is; times in seconds of the clock."""

    name: str
    can_cancel: bool
    begun: float
    label: str = ""
    done: int = 0
    total: int | None = None
    label_begun: float = 0.0
    is_cancelled: bool = False


class Jobs:
    """The job that runs, if one does.

    Args:
        clock: seconds that only ever grow.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._job: _Job | None = None
        self._lock = threading.Lock()

    @contextmanager
    def running(self, name: str, *, can_cancel: bool) -> Iterator[None]:
        """Run the block as a job: the progress that its thread reports is the job's.

        Raises:
            UsageError: another job runs.
            Cancelled: `cancel` was called before the block ended.
        """
        job = _Job(name, can_cancel, self._clock())
        with self._lock:
            if self._job is not None:
                fix = "wait for it, or cancel it."
                raise UsageError(name, "", expected="no other job", got=f"{self._job.name} still running", fix=fix)
            self._job = job

        def listener(label: str, done: int, total: int | None) -> None:
            _stop_if_cancelled(job)
            with self._lock:
                if label != job.label or done == 0:
                    job.label, job.label_begun = label, self._clock()
                job.done, job.total = done, total

        try:
            with listened_by(listener):
                yield
            _stop_if_cancelled(job)
        finally:
            with self._lock:
                self._job = None

    def cancel(self) -> None:
        """End the job at its next step, if it can be cancelled; nothing if none runs."""
        with self._lock:
            if self._job is not None and self._job.can_cancel:
                self._job.is_cancelled = True

    def state(self) -> dict[str, Any] | None:
        """The job as plain data; None if none runs.

        Returns:
            `name`, `can_cancel`, `is_cancelled`; `label`, `done` and `total` of its present loop, total None where it
            is not known; `seconds` it has taken, and `seconds_left` of the loop, None before its first step.
        """
        with self._lock:
            job = self._job
            if job is None:
                return None
            now = self._clock()
            left = None
            if job.total and job.done:
                left = (now - job.label_begun) / job.done * (job.total - job.done)
            return {
                "name": job.name,
                "can_cancel": job.can_cancel,
                "is_cancelled": job.is_cancelled,
                "label": job.label,
                "done": job.done,
                "total": job.total,
                "seconds": now - job.begun,
                "seconds_left": left,
            }


def _stop_if_cancelled(job: _Job) -> None:
    if job.is_cancelled:
        raise Cancelled(job.name)
