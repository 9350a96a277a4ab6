"""The base of every set of parameters: a stage's, or a format's options."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict


class Params(BaseModel):
    """Immutable, and strict about names: a misspelt parameter is an error, never a default.

    Each field's `description` becomes the `--help` of its option. Only what changes the result belongs here: jobs,
    device and batch size of inference are no params, because they would make the same result look different.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
