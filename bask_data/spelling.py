"""Suggestions for misspelt names, and the choices there are."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches

MOST_CHOICES = 20
"""Names listed in a message: all stages, options and splits, but not thousands of scenes."""


def number_of(n: int, noun: str) -> str:
    """A number with its noun, which takes an s unless there is one: `1 camera`, `2 cameras`."""
    return f"{n} {noun}{'' if n == 1 else 's'}"


def suggestion(name: str, choices: Iterable[str]) -> str:
    """`did you mean X?` for the most similar existing name; empty if none is similar.

    Case does not matter, nor does `-` or `_`: `--voxel_size` matches `--voxel-size`.
    """
    by_spelling = {_plain(choice): choice for choice in choices}
    near = get_close_matches(_plain(name), by_spelling, n=1, cutoff=0.6)
    return f"did you mean {by_spelling[near[0]]}?" if near else ""


def choices(names: Iterable[str]) -> str:
    """The names, separated by commas; of many, the first and the number of the others."""
    listed = list(map(str, names))
    more = len(listed) - MOST_CHOICES
    return ", ".join(listed) if more <= 0 else f"{', '.join(listed[:MOST_CHOICES])} and {more:,} more"


def _plain(name: str) -> str:
    return name.lower().replace("-", "_")
