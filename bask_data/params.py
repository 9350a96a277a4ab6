"""The base of every set of parameters: a stage's, or a format's options."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from typing import Any

from pydantic import BaseModel, ConfigDict, ValidationError

_MOST_SHOWN = 80
"""Characters of what came: enough to find it again."""

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
"""What pydantic's names of types, with which its codes of errors begin, mean to a person."""

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
"""By pydantic's code of an error, where its own words would not do."""

_OF_TYPE = re.compile(rf"({'|'.join(_TYPES)})_(type|parsing|parsing_size)")


class Params(BaseModel):
    """Immutable, and strict about names: a misspelt parameter is an error, never a default.

    Each field's `description` becomes the `--help` of its option. Only what changes the result belongs here: jobs,
    device and batch size of inference are no params, because they would make the same result look different.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    def reads(self, kind: str) -> tuple[str, ...] | None:
        """Items whose artifacts of a kind these parameters need, for a stage that may do without some; None: all.

        What is not read is no part of the key and need not be there. It is left out of the list that a stage gathers; a
        single input, declared `Kind | None`, is None where this gives ().
        """
        return None


def first_fault(error: ValidationError) -> tuple[str, str, str]:
    """The first thing that is wrong: its field, what was expected there in plain words, and what came."""
    fault = error.errors()[0]
    # What came for a missing value is the whole that lacks it, which is no answer.
    came = "none" if fault["type"] == "missing" else _as_came(fault["input"])
    return ".".join(map(str, fault["loc"])), _expected(fault["type"], fault["msg"], fault.get("ctx", {})), came


def _expected(code: str, message: str, context: Mapping[str, Any]) -> str:
    if code in _PLAIN:
        return _PLAIN[code]
    if of_type := _OF_TYPE.fullmatch(code):
        return _TYPES[of_type[1]]
    if code == "literal_error":
        return "one of " + context["expected"].replace("'", "").replace(" or ", ", ")
    if code in ("too_short", "too_long"):
        bound = ("at least", context.get("min_length")) if code == "too_short" else ("at most", context["max_length"])
        return f"{bound[0]} {bound[1]} values"
    return _WORDY.sub("", message)


def _as_came(value: Any) -> str:
    """A value as it was typed or written: text in quotes, so that an empty or a blank one is seen."""
    return f"'{value[:_MOST_SHOWN]}'" if isinstance(value, str) else json.dumps(value, default=str)[:_MOST_SHOWN]
