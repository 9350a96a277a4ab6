"""JSON files from strangers: bounded, and with values of the type that is needed."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from bask_data.errors import BadData
from bask_data.formats.files import MAX_TEXT_BYTES, read_bytes


def read_json(path: Path) -> dict[str, Any]:
    """The object in a JSON file; `BadData` if it is none, or larger than `MAX_TEXT_BYTES`."""
    return parse_json(path, read_bytes(path, MAX_TEXT_BYTES))


def parse_json(where: Path | str, data: bytes) -> dict[str, Any]:
    """As `read_json`, from the content of a file; `where` is for messages."""
    try:
        value = json.loads(data.decode("utf-8-sig"))
    except (ValueError, RecursionError) as error:
        got = str(error)[:200]
        raise BadData(where, "content", expected="JSON", got=got, fix="copy it again from its source.") from error
    if not isinstance(value, dict):
        raise BadData(where, "content", expected="a JSON object {...}", got=f"a {type(value).__name__}")
    return value


def number(where: Path | str, table: Mapping[str, Any], key: str, default: float | None = None) -> float:
    """The finite number at a key; `BadData` for anything else, or if it is missing and there is no default."""
    value = table.get(key, default)
    if isinstance(value, int | float) and not isinstance(value, bool):
        try:
            result = float(value)
        except OverflowError:
            result = math.inf
        if math.isfinite(result):
            return result
    raise BadData(where, key, expected="a number", got="nothing" if value is None else repr(value)[:80])


def array(where: Path | str, field: str, value: Any, shapes: Sequence[tuple[int, ...]]) -> Float[ndarray, "..."]:
    """Nested lists of numbers, maybe not finite, as an array of one of the shapes; `BadData` for anything else.

    Args:
        shapes: lengths along each axis; -1 is any length.
    """
    result: ndarray | None
    try:
        result = np.array(value, np.float64)
    except (ValueError, TypeError, OverflowError):
        result = None
    for shape in shapes:
        if (
            result is not None
            and len(shape) == result.ndim
            and all(a in (-1, b) for a, b in zip(shape, result.shape, strict=True))
        ):
            return result
    sizes = " or ".join(" x ".join("n" if length < 0 else str(length) for length in shape) for shape in shapes)
    raise BadData(where, field, expected=f"{sizes} numbers", got=repr(value)[:80])
