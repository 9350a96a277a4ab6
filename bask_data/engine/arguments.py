"""What a stage's function is called with."""

from __future__ import annotations

import typing
from typing import Any

from bask_data.dataset import Splits
from bask_data.engine.tasks import Task

RUNS = "runs"
"""Folder of a dataset where stages log what differs from run to run, as `provenance` tells who made what."""


def arguments_of(task: Task) -> dict[str, Any]:
    """What a stage's function is called with, but for `out`."""
    arguments: dict[str, Any] = {}
    for given in task.stage.inputs:
        handles = [given.artifact(task.input_path(binding)) for binding in task.inputs[given.name]]
        for handle in handles:
            handle.check_complete()
        arguments[given.name] = handles if given.gather else next(iter(handles), None)
    hints = typing.get_type_hints(task.stage.function)
    for name, hint in hints.items():
        if hint is Splits:
            arguments[name] = task.splits
    if "params" in hints:
        arguments["params"] = task.params
    if "log" in hints:
        arguments["log"] = task.root / RUNS / task.target.relative_to(task.root)
    return arguments
