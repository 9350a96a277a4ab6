"""Base of all sets of parameters: those of stages, and the options of formats."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from typing import Any

from pydantic import BaseModel, ConfigDict, ValidationError

_MOST_SHOWN = 80
"""Characters shown of a refused value or of the path to its field: enough to recognise it."""

_WORDY = re.compile(r"^(Input should (be )?|Value error, )|, (unable|got) .*$|\bvalid ")
_TYPES = {
    "bool": "true or false",
    "date": "a date",
    "dict": "values by name",
    "float": "a number",
    "int": "a whole number",
    "list": "a list",
    "mapping": "values by name",
    "model": "values by name",
    "string": "text",
    "tuple": "a list",
}
"""Plain words for pydantic's type names, which begin its error codes."""

_PLAIN = {
    "extra_forbidden": "no field of that name",
    "finite_number": "a finite number",
    "int_from_float": "a whole number",
    "json_invalid": "JSON",
    "json_type": "JSON",
    "missing": "a value",
    "model_attributes_type": "values by name",
    "none_required": "nothing",
}
"""Plain words by pydantic's error code, where its message is not usable."""

NAME = r"^[A-Za-z0-9][A-Za-z0-9_-]*$"
"""Pattern of a camera's name, which becomes the name of a folder."""

NAMES = r"^[A-Za-z0-9][A-Za-z0-9_-]*(,[A-Za-z0-9][A-Za-z0-9_-]*)*$"
"""Pattern of cameras' names, separated by commas."""

SIZE = r"^(\d+x\d+)?$"
"""Pattern of an image size in pixels; may be empty."""

WHOLE_NUMBERS = r"^(\d+(,\d+)*)?$"
"""Pattern of a list of whole numbers; may be empty."""

FRAMES = r"^(\d+|-?\d*:-?\d*(:[1-9]\d*)?)?$"
"""Pattern of a range of frames, FIRST:END:STEP; may be empty."""

SHA256 = "^[0-9a-f]{64}$"
"""Pattern of a digest."""

PATTERNS = {
    NAME: "letters, digits, '_' and '-', beginning with a letter or digit",
    NAMES: "names separated by commas, of letters, digits, '_' and '-', for instance wrist,overhead",
    SIZE: "WIDTHxHEIGHT in pixels, for instance 640x480",
    WHOLE_NUMBERS: "whole numbers separated by commas, for instance 65535",
    FRAMES: "FIRST:END:STEP, for instance 10:500:2",
    SHA256: "a SHA-256, 64 hexadecimal digits",
}
"""Plain words by pattern: a regular expression does not tell a user what to write."""

_OF_TYPE = re.compile(rf"({'|'.join(_TYPES)})_(type|parsing|parsing_size)")


class Params(BaseModel):
    """Immutable parameters with strict names: a misspelt parameter is an error, never a default.

    Each field's `description` is the `--help` of its option. Only what changes the result belongs here: jobs, device
    and inference batch size are not parameters, as they would give equal results different keys.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    def reads(self, kind: str) -> tuple[str, ...] | None:
        """Names of the items whose artifacts of a kind are needed with these parameters; None for all.

        Other artifacts are not part of the key and need not exist. They are left out of the list that a stage gathers;
        a single input, declared `Kind | None`, is None if this returns ().
        """
        return None


def first_fault(error: ValidationError) -> tuple[str, str, str]:
    """The first error: its field, what was expected in plain words, and the value that was given."""
    fault = error.errors()[0]
    if fault["type"] == "missing" and isinstance(fault["loc"][-1], int):
        return _too_few(error)
    # For a missing value pydantic gives the whole model as input.
    came = "none" if fault["type"] == "missing" else _as_came(fault["input"])
    return _field(fault["loc"]), _expected(fault["type"], fault["msg"], fault.get("ctx", {})), came


def _field(location: tuple[int | str, ...]) -> str:
    # A choice whose tag is empty is the usual one, and no part of the name.
    field = ".".join(str(part) for part in location if part != "")
    return f"{field[:_MOST_SHOWN]}..." if len(field) > _MOST_SHOWN else field  # Deeply nested JSON.


def _too_few(error: ValidationError) -> tuple[str, str, str]:
    """`first_fault` of a list of fixed length that is too short: pydantic reports each missing value."""
    first = error.errors()[0]
    of_list = first["loc"][:-1]
    n_missing = sum(fault["type"] == "missing" and fault["loc"][:-1] == of_list for fault in error.errors())
    n_given = len(first["input"])
    return _field(of_list), f"{n_given + n_missing} values", f"{n_given}: {_as_came(first['input'])}"


def _expected(code: str, message: str, context: Mapping[str, Any]) -> str:
    if code in _PLAIN:
        return _PLAIN[code]
    if of_type := _OF_TYPE.fullmatch(code):
        return _TYPES[of_type[1]]
    if code == "literal_error":
        return "one of " + context["expected"].replace("'", "").replace(" or ", ", ")
    if code == "string_pattern_mismatch" and context["pattern"] in PATTERNS:
        return PATTERNS[context["pattern"]]
    if code in ("too_short", "too_long"):
        bound = ("at least", context.get("min_length")) if code == "too_short" else ("at most", context["max_length"])
        return f"{bound[0]} {bound[1]} values"
    return _WORDY.sub("", message)


def _as_came(value: Any) -> str:
    """A value as given: text in quotes, so that empty or blank text is visible."""
    if isinstance(value, list | tuple) and value and all(isinstance(each, str) for each in value):
        value = ",".join(value)  # As an option gives it.
    return f"'{value[:_MOST_SHOWN]}'" if isinstance(value, str) else json.dumps(value, default=str)[:_MOST_SHOWN]
