"""Progress of long loops, told to whoever listens."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import TypeVar

T = TypeVar("T")
Listener = Callable[[str, int, int | None], None]
"""Called with (label, done, total); total is None when it is not known."""

Hearer = Callable[[str], None]
"""Called with a line for a person."""

_listener: Listener | None = None
_hearer: Hearer | None = None
_thread = threading.local()


def listen(listener: Listener | None, hearer: Hearer | None = None) -> None:
    """Send the progress of this process to `listener` and what it tells to `hearer`, or to nobody."""
    global _listener, _hearer
    _listener, _hearer = listener, hearer


@contextmanager
def listened_by(listener: Listener) -> Iterator[None]:
    """Send the progress of this thread to `listener` as well; an exception it raises ends the loop that reports."""
    before = getattr(_thread, "listeners", ())
    _thread.listeners = (*before, listener)
    try:
        yield
    finally:
        _thread.listeners = before


def tell(text: str) -> None:
    """Tell what is worth knowing before a loop has ended."""
    if _hearer is not None:
        _hearer(text)


def report(label: str, done: int, total: int | None) -> None:
    """Tell that `done` of `total` steps are done."""
    if _listener is not None:
        _listener(label, done, total)
    for listener in getattr(_thread, "listeners", ()):
        listener(label, done, total)


def progress(items: Iterable[T], label: str, total: int | None = None) -> Iterator[T]:
    """The same items, telling how far the loop is."""
    if total is None and hasattr(items, "__len__"):
        total = len(items)  # type: ignore[arg-type]
    report(label, 0, total)
    for done, item in enumerate(items, start=1):
        yield item
        report(label, done, total)


class Steps:
    """Progress of several loops that are one piece of work, counted in steps that take about as long."""

    def __init__(self, label: str, total: int) -> None:
        """Report that none of `total` steps is done."""
        self._label, self._done, self._total = label, 0, total
        report(label, 0, total)

    def over(self, items: Iterable[T], weight: int = 1) -> Iterator[T]:
        """The same items, each of which is `weight` steps when the next is asked for."""
        for item in items:
            yield item
            self.reach(self._done + weight)

    def reach(self, done: int) -> None:
        """Report that `done` steps are done: also what was left out counts."""
        self._done = min(done, self._total)
        report(self._label, self._done, self._total)
