"""Threads that should have ended."""

from __future__ import annotations

import gc
import threading
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def no_garbage_collector() -> Iterator[None]:
    """What is not ended by whoever began it shows: the collector would end it, at some time and on some thread."""
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


def threads_named(prefix: str) -> list[threading.Thread]:
    return [thread for thread in threading.enumerate() if thread.name.startswith(prefix)]
