"""Progress of long loops, reported to listeners."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import TypeVar

T = TypeVar("T")
Listener = Callable[[str, int, int | None], None]
"""Called with (label, done, total); total is None when it is not known."""

NoteListener = Callable[[str], None]
"""Called with a line of text."""

_listener: Listener | None = None
_note_listener: NoteListener | None = None
_thread = threading.local()


_STEPS_MEASURED = 3
"""Steps, after the first, that must be done before the time left is estimated. Chosen; sensitivity not measured."""


class Pace:
    """Estimate of the time that a loop still takes, from the steps after its first.

    The first step is left out: it also loads files and compiles code, and may take longer than all others together.
    """

    def __init__(self) -> None:
        self._label, self._n, self._begun = "", 0, 0.0

    def seconds_left(self, label: str, done: int, total: int | None) -> float | None:
        """Seconds left after a report of progress, all of which are to be passed; None while unknown."""
        now = time.monotonic()
        if label != self._label or done < self._n or not self._n:
            self._label, self._n, self._begun = label, done, now
        measured = done - self._n
        if total is None or not self._n or measured < _STEPS_MEASURED:
            return None
        return (now - self._begun) / measured * (total - done)


def listen(listener: Listener | None, note_listener: NoteListener | None = None) -> None:
    """Send the progress of this process to `listener` and its notes to `note_listener`; None for neither."""
    global _listener, _note_listener
    _listener, _note_listener = listener, note_listener


@contextmanager
def listened_by(listener: Listener) -> Iterator[None]:
    """Also send the progress of this thread to `listener`, whose exceptions end the reporting loop."""
    before = getattr(_thread, "listeners", ())
    _thread.listeners = (*before, listener)
    try:
        yield
    finally:
        _thread.listeners = before


def note(text: str) -> None:
    """Report something worth knowing before a loop has ended."""
    if _note_listener is not None:
        _note_listener(text)


def report(label: str, done: int, total: int | None) -> None:
    """Report that `done` of `total` steps are done."""
    if _listener is not None:
        _listener(label, done, total)
    for listener in getattr(_thread, "listeners", ()):
        listener(label, done, total)


def progress(items: Iterable[T], label: str, total: int | None = None) -> Iterator[T]:
    """The same items, with progress reported after each."""
    if total is None and hasattr(items, "__len__"):
        total = len(items)  # type: ignore[arg-type]
    report(label, 0, total)
    for done, item in enumerate(items, start=1):
        yield item
        report(label, done, total)


class Steps:
    """Progress of several loops as one, counted in steps of about equal duration."""

    def __init__(self, label: str, total: int) -> None:
        """Report that none of `total` steps is done."""
        self._label, self._done, self._total = label, 0, total
        report(label, 0, total)

    def over(self, items: Iterable[T], weight: int = 1) -> Iterator[T]:
        """The same items; each counts as `weight` steps once the next is requested."""
        for item in items:
            yield item
            self.reach(self._done + weight)

    def reach(self, done: int) -> None:
        """Report that `done` steps are done, including skipped ones."""
        self._done = min(done, self._total)
        report(self._label, self._done, self._total)
