"""Loops over pixels and points that NumPy has no words for, compiled by Numba."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from numba import njit

F = TypeVar("F", bound=Callable[..., object])


def compiled(function: F) -> F:
    """The function as machine code. It is kept on disk for the next process, where a place for that can be written to;
    a container may have none, and then each process compiles for itself. While it runs, other threads do, too."""
    try:
        return njit(cache=True, nogil=True)(function)
    except RuntimeError:
        return njit(nogil=True)(function)
