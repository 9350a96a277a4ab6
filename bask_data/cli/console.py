"""Terminal output: results on stdout, for pipes; progress, outcomes, notes and errors on stderr."""

from __future__ import annotations

import json
import os
import re
import sys
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from bask_data import progress
from bask_data.errors import BaskError

if TYPE_CHECKING:
    from bask_data.engine import Outcome

_SECONDS_BETWEEN_LINES = 10.0
"""Interval of progress lines in a log: short enough to show progress, long enough to keep the log readable."""
_ESCAPES = re.compile(r"\x1b\[[0-9;]*[A-Za-z]|[\x00-\x08\x0b-\x1f\x7f-\x9f]")
_MARKS = {
    "made": "made",
    "up to date": "up to date",
    "failed": "FAILED",
    "blocked": "blocked",
    "would make": "would make",
    "may make": "may make",
}


def say(text: str) -> None:
    """Print a line to stderr. Escape sequences are removed: libraries and names in untrusted files contain some."""
    print(_ESCAPES.sub("", text), file=sys.stderr, flush=True)


def warn(text: str) -> None:
    """Print a warning to stderr, in colour on a terminal: what a user must not overlook."""
    is_coloured = sys.stderr.isatty() and not os.environ.get("NO_COLOR")
    mark = "\x1b[1;33mwarning:\x1b[0m" if is_coloured else "warning:"
    print(f"{mark} {_ESCAPES.sub('', text)}", file=sys.stderr, flush=True)


def print_result(command: str, lines: Iterable[str], document: Mapping[str, Any], as_json: bool) -> None:
    """Print a command's result to stdout, as lines of text or as one JSON document."""
    if as_json:
        print(json.dumps({"command": command, **document}, indent=2), flush=True)
        return
    for line in lines:
        print(_ESCAPES.sub("", line), flush=True)


def show_outcome(outcome: Outcome) -> None:
    """Print one line for an outcome; errors in full."""
    seconds = f"  {duration(outcome.seconds)}" if outcome.seconds >= 0.05 else ""
    why = f"  ({outcome.why})" if outcome.why and outcome.status != "failed" else ""
    say(f"  {_MARKS[outcome.status]:<10}  {outcome.label}{seconds}{why}")
    if outcome.status == "failed":
        say(f"error: {outcome.why}")


def show_error(error: BaskError) -> None:
    """Print an error with its notes, without a traceback."""
    say("\n".join([f"error: {error}", *getattr(error, "__notes__", [])]))


@contextmanager
def shown_progress() -> Iterator[None]:
    """Show the progress of long loops: a bar on a terminal, otherwise a line every ten seconds."""
    listener = _Bar() if sys.stderr.isatty() else _Lines()
    progress.listen(listener, lambda text: listener.print(f"  ...         {text}"))
    try:
        yield
    finally:
        progress.listen(None)
        listener.close()


class _Lines:
    """Progress as a line every ten seconds, for logs."""

    def __init__(self) -> None:
        self._label, self._said, self._pace = "", 0.0, progress.Pace()

    def __call__(self, label: str, done: int, total: int | None) -> None:
        now, left = time.monotonic(), self._pace.seconds_left(label, done, total)
        if label != self._label or done == 0:
            self._label, self._said = label, now
        if now - self._said >= _SECONDS_BETWEEN_LINES:
            self._said = now
            say(f"  ...         {label} {done}{f'/{total}' if total else ''}{_in_words(left, ', ')}")

    def print(self, text: str) -> None:
        """Print a line between those of the loop."""
        say(text)

    def close(self) -> None:
        """Do nothing: lines stay."""


class _Bar:
    """Progress as a bar that disappears when its loop ends."""

    def __init__(self) -> None:
        self._progress: Any = None
        self._pace = progress.Pace()
        self._task: Any = None
        self._label = ""

    def __call__(self, label: str, done: int, total: int | None) -> None:
        left = _in_words(self._pace.seconds_left(label, done, total))
        if self._progress is None:
            from rich.console import Console
            from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

            labels = TextColumn("  {task.description}"), TextColumn("{task.fields[left]}")
            columns = (labels[0], BarColumn(), MofNCompleteColumn(), labels[1])
            self._progress = Progress(*columns, console=Console(stderr=True), transient=True)
            self._progress.start()
        if label != self._label or done == 0:
            if self._task is not None:
                self._progress.remove_task(self._task)
            self._label, self._task = label, self._progress.add_task(label, total=total, left="")
        self._progress.update(self._task, completed=done, total=total, left=left)
        if done == total:
            self.close()

    def print(self, text: str) -> None:
        """Print a line above the bar."""
        if self._progress is None:
            say(text)
        else:
            self._progress.console.print(_ESCAPES.sub("", text), markup=False, highlight=False, soft_wrap=True)

    def close(self) -> None:
        """Remove the bar, so that lines can be printed."""
        if self._progress is not None:
            self._progress.stop()
        self._progress, self._task, self._label = None, None, ""


def _in_words(seconds_left: float | None, before: str = "") -> str:
    return "" if seconds_left is None else f"{before}about {duration(seconds_left)} left"


def duration(seconds: float) -> str:
    """Seconds in readable units: `4.2 s`, `3 min 5 s`, `2 h 10 min`."""
    if seconds < 60:
        return f"{seconds:.1f} s"
    if seconds < 3600:
        return f"{int(seconds) // 60} min {int(seconds) % 60} s"
    return f"{int(seconds) // 3600} h {int(seconds) % 3600 // 60} min"
