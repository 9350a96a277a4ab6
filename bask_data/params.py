"""The base of every set of parameters: a stage's, or a format's options."""

from __future__ import annotations

import json
import re

from pydantic import BaseModel, ConfigDict, ValidationError

_WORDY = re.compile(r"^(Input should (be )?|Value error, )|, (unable|got) .*$|\bvalid |(?<=items) after validation")
_SHORT = {"missing": "a value", "extra_forbidden": "no field of that name"}


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
    came = "none" if fault["type"] == "missing" else json.dumps(fault["input"], default=str)[:80]
    expected = _SHORT.get(fault["type"]) or _WORDY.sub("", fault["msg"]).replace("a integer", "a whole number")
    return ".".join(map(str, fault["loc"])), expected, came
