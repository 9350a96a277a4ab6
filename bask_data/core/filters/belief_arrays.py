"""A filter's belief as named arrays, and back: what a file can hold without any code in it."""

from __future__ import annotations

import types
from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from typing import Any, get_args, get_origin, get_type_hints

import numpy as np
from numpy import ndarray

from bask_data.core.filters.table import FilterSettings, filter_of

_LENGTH = "n"
"""Entry of a tuple that says how long it is: what is None in it has no entries."""


def to_arrays(belief: Any) -> dict[str, ndarray]:
    """Everything in a belief, by its place in it; nothing of None."""
    return {} if belief is None else dict(_entries(belief, "belief"))


def from_arrays(arrays: Mapping[str, ndarray], settings: FilterSettings) -> Any:
    """The belief of a filter with these settings that `to_arrays` gave `arrays` for."""
    return _built(filter_of(settings).belief | None, "belief", arrays)


def _entries(value: Any, place: str) -> Iterator[tuple[str, ndarray]]:
    if is_dataclass(value):
        for field in fields(value):
            yield from _entries(getattr(value, field.name), f"{place}.{field.name}")
    elif isinstance(value, tuple):
        yield f"{place}.{_LENGTH}", np.array(len(value))
        for i, one in enumerate(value):
            yield from _entries(one, f"{place}.{i}")
    elif value is not None:
        yield place, np.asarray(value)


def _built(kind: Any, place: str, arrays: Mapping[str, ndarray]) -> Any:
    if isinstance(kind, types.UnionType):
        (of,) = (one for one in get_args(kind) if one is not types.NoneType)
        there = any(name == place or name.startswith(f"{place}.") for name in arrays)
        return _built(of, place, arrays) if there else None
    if is_dataclass(kind):
        hints = get_type_hints(kind)
        # A type checker takes a dataclass for an instance of one here.
        return kind(**{one.name: _built(hints[one.name], f"{place}.{one.name}", arrays) for one in fields(kind)})  # type: ignore[operator]
    if get_origin(kind) is tuple:
        of = get_args(kind)[0]
        return tuple(_built(of, f"{place}.{i}", arrays) for i in range(int(arrays[f"{place}.{_LENGTH}"].item())))
    return arrays[place]
