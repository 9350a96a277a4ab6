"""Processes started by torchrun that make one artifact together."""

from __future__ import annotations

import os

from bask_data.artifact import digest_of
from bask_data.engine.arguments import arguments_of
from bask_data.engine.state import key_parts, state_of
from bask_data.engine.tasks import Task


def processes() -> int:
    """Number of processes that torchrun started; 1 without torchrun."""
    return int(os.environ["WORLD_SIZE"]) if "TORCHELASTIC_RUN_ID" in os.environ else 1


def is_follower() -> bool:
    """Whether another process of the group publishes the artifact."""
    return processes() > 1 and os.environ["RANK"] != "0"


def follow(task: Task, force: bool) -> None:
    """Take part in making an artifact as a process other than the first, which alone locks, publishes and reports.

    All processes decide from the same files whether there is anything to make, so they agree.
    """
    if force or state_of(task).status in ("missing", "stale"):
        task.stage.function(**arguments_of(task), out=task.resumable_scratch(digest_of(key_parts(task))))
