"""Several processes that make one artifact together, as torchrun starts them."""

from __future__ import annotations

import os

from bask_data.artifact import digest_of
from bask_data.engine.arguments import arguments_of
from bask_data.engine.state import key_parts, state_of
from bask_data.engine.tasks import Task


def processes() -> int:
    """How many processes torchrun started to make one artifact together; 1 without it."""
    return int(os.environ["WORLD_SIZE"]) if "TORCHELASTIC_RUN_ID" in os.environ else 1


def is_follower() -> bool:
    """Whether another of them is the one that publishes."""
    return processes() > 1 and os.environ["RANK"] != "0"


def follow(task: Task, force: bool) -> None:
    """Take part in what the first of several processes makes; it alone locks, publishes and reports.

    All of them decide by the same files whether there is anything to make, so they come to the same answer.
    """
    if force or state_of(task).status in ("missing", "stale"):
        task.stage.function(**arguments_of(task), out=task.resumable_scratch(digest_of(key_parts(task))))
