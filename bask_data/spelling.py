"""What a misspelt name most likely meant."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches


def suggestion(name: str, choices: Iterable[str]) -> str:
    """`did you mean X?` for the nearest of the names that exist; empty if none is near.

    Letters' case, `-` and `_` do not count: `--voxel_size` is near `--voxel-size`.
    """
    spelt = {_plain(choice): choice for choice in choices}
    near = get_close_matches(_plain(name), spelt, n=1, cutoff=0.6)
    return f"did you mean {spelt[near[0]]}?" if near else ""


def _plain(name: str) -> str:
    return name.lower().replace("-", "_")
