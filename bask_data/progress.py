"""Progress of long loops, told to whoever listens."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import TypeVar

T = TypeVar("T")
Listener = Callable[[str, int, int | None], None]
"""Called with (label, done, total); total is None when it is not known."""

Hearer = Callable[[str], None]
"""Called with a line for a person."""

_listener: Listener | None = None
_hearer: Hearer | None = None


def listen(listener: Listener | None, hearer: Hearer | None = None) -> None:
    """Send the progress of this process to `listener` and what it tells to `hearer`, or to nobody."""
    global _listener, _hearer
    _listener, _hearer = listener, hearer


def tell(text: str) -> None:
    """Tell what is worth knowing before a loop has ended."""
    if _hearer is not None:
        _hearer(text)


def report(label: str, done: int, total: int | None) -> None:
    """Tell that `done` of `total` steps are done."""
    if _listener is not None:
        _listener(label, done, total)


def progress(items: Iterable[T], label: str, total: int | None = None) -> Iterator[T]:
    """The same items, telling how far the loop is."""
    if total is None and hasattr(items, "__len__"):
        total = len(items)  # type: ignore[arg-type]
    report(label, 0, total)
    for done, item in enumerate(items, start=1):
        yield item
        report(label, done, total)
