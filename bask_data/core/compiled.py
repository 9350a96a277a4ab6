"""Compilation, by Numba, of loops over pixels and points that NumPy cannot express."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from numba import njit

F = TypeVar("F", bound=Callable[..., object])


def compiled(function: F) -> F:
    """The function as machine code, which releases the GIL. It is cached on disk for other processes; where no cache
    directory is writable, as in some containers, each process compiles it again."""
    try:
        return njit(cache=True, nogil=True)(function)
    except RuntimeError:
        return njit(nogil=True)(function)
