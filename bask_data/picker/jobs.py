"""Long work for the page: one job at a time, with progress and cancellation."""

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
    """The job was cancelled; raised where it reports progress."""


@dataclass
class _Job:
    """The running job and the progress of its current loop; times in seconds of the clock."""

    name: str
    can_cancel: bool
    begun: float
    label: str = ""
    done: int = 0
    total: int | None = None
    label_begun: float = 0.0
    is_cancelled: bool = False


class Jobs:
    """At most one running job.

    Args:
        clock: monotonic time, seconds.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._job: _Job | None = None
        self._lock = threading.Lock()
        self._is_idle = threading.Condition(self._lock)

    @contextmanager
    def running(self, name: str, *, can_cancel: bool) -> Iterator[None]:
        """Run the block as a job, whose progress is what the thread reports.

        Raises:
            UsageError: another job is running.
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
                self._is_idle.notify_all()

    def wait(self) -> None:
        """Wait until no job is running."""
        with self._is_idle:
            self._is_idle.wait_for(lambda: self._job is None)

    def cancel(self) -> None:
        """Stop the running job at its next step, if it can be cancelled."""
        with self._lock:
            if self._job is not None and self._job.can_cancel:
                self._job.is_cancelled = True

    def state(self) -> dict[str, Any] | None:
        """The running job as plain data; None if there is none.

        Returns:
            `name`, `can_cancel`, `is_cancelled`; `label`, `done` and `total` of its current loop (`total` None if
            unknown); `seconds` since its start, and `seconds_left` of the loop (None before its first step).
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
