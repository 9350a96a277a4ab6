"""Arguments of a stage's function."""

from __future__ import annotations

import typing
from typing import Any

from bask_data.dataset import Splits
from bask_data.engine.tasks import Task

RUNS = "runs"
"""Folder of a dataset for logs of stages: like `provenance`, they differ between runs."""


def arguments_of(task: Task) -> dict[str, Any]:
    """The arguments of a task's function, except `out`; `BadData` if an input is damaged or incomplete."""
    arguments: dict[str, Any] = {}
    for input_ in task.stage.inputs:
        handles = [input_.artifact(task.input_path(binding)) for binding in task.inputs[input_.name]]
        for handle in handles:
            handle.check_complete()
        arguments[input_.name] = handles if input_.gather else next(iter(handles), None)
    hints = typing.get_type_hints(task.stage.function)
    for name, hint in hints.items():
        if hint is Splits:
            arguments[name] = task.splits
    if "params" in hints:
        arguments["params"] = task.params
    if "log" in hints:
        arguments["log"] = task.root / RUNS / task.target.relative_to(task.root)
    return arguments
