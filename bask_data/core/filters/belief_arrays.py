"""A filter's belief as named arrays, and back: a form that a file can store without any code in it."""

from __future__ import annotations

import types
from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from typing import Any, get_args, get_origin, get_type_hints

import numpy as np
from numpy import ndarray

from bask_data.core.filters.table import FilterSettings, filter_of

_LENGTH = "n"
"""Entry with the length of a tuple, because elements that are None have no entries."""


def to_arrays(belief: Any) -> dict[str, ndarray]:
    """All arrays of a belief by their path in it, without those that are None."""
    return {} if belief is None else dict(_entries(belief, "belief"))


def from_arrays(arrays: Mapping[str, ndarray], settings: FilterSettings) -> Any:
    """The belief that `to_arrays` converted, of a filter with these settings."""
    return _built(filter_of(settings).belief | None, "belief", arrays)


def _entries(value: Any, path: str) -> Iterator[tuple[str, ndarray]]:
    if is_dataclass(value):
        for field in fields(value):
            yield from _entries(getattr(value, field.name), f"{path}.{field.name}")
    elif isinstance(value, tuple):
        yield f"{path}.{_LENGTH}", np.array(len(value))
        for i, element in enumerate(value):
            yield from _entries(element, f"{path}.{i}")
    elif value is not None:
        yield path, np.asarray(value)


def _built(kind: Any, path: str, arrays: Mapping[str, ndarray]) -> Any:
    if isinstance(kind, types.UnionType):
        (of,) = (member for member in get_args(kind) if member is not types.NoneType)
        is_present = any(name == path or name.startswith(f"{path}.") for name in arrays)
        return _built(of, path, arrays) if is_present else None
    if is_dataclass(kind):
        hints = get_type_hints(kind)
        # A type checker takes the dataclass for an instance here.
        return kind(**{field.name: _built(hints[field.name], f"{path}.{field.name}", arrays) for field in fields(kind)})  # type: ignore[operator]
    if get_origin(kind) is tuple:
        of = get_args(kind)[0]
        return tuple(_built(of, f"{path}.{i}", arrays) for i in range(int(arrays[f"{path}.{_LENGTH}"].item())))
    return arrays[path]
