"""Whether an artifact is up to date: its skip key, and in words what differs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from bask_data.artifact import MANIFEST, Manifest, digest_of, file_digest, read_manifest
from bask_data.engine.tasks import Binding, Task, parameter_files
from bask_data.errors import BadData, BaskError


@dataclass(frozen=True)
class State:
    """Whether a task has to run.

    Args:
        status: `blocked` when an input is missing.
        why: in words, for `missing` empty, or foretold what it comes after.
    """

    status: Literal["up to date", "missing", "stale", "blocked"]
    why: str = ""


def key_parts(task: Task) -> dict[str, Any]:
    """Everything the result depends on; its digest is the skip key. `BadData` when an input has no manifest."""
    parts = {
        "kind": task.stage.makes.kind,
        "schema": task.stage.makes.schema_version,
        "stage": task.stage.name,
        "version": task.stage.version,
        "params": task.params.model_dump(mode="json"),
        "inputs": {path.relative_to(task.root).as_posix(): read_manifest(path).digest for path in task.input_paths},
    }
    if task.stage.wants_splits:
        parts["splits"] = task.splits.model_dump(mode="json")
    files = {name: file_digest(path) for name, path in parameter_files(task).items()}
    return {**parts, "files": files} if files else parts


def state_of(task: Task) -> State:
    """Whether a task has to run, and why."""
    for bindings in task.inputs.values():
        for binding in bindings:
            path = task.input_path(binding)
            if not (path / MANIFEST).exists():
                return State("blocked", f"{path.relative_to(task.root).as_posix()} is missing{_instead(binding, path)}")
    wanted = [given for given in task.stage.inputs if task.params.reads(given.artifact.kind) is None]
    for given in wanted:
        if not task.inputs[given.name]:
            what = "scenes" if given.artifact.scope == "scene" else given.artifact.kind
            return State("blocked", f"the dataset has no {what}")
    if not task.target.exists():
        return State("missing")
    try:
        manifest = read_manifest(task.target)
    except BadData:
        return State("stale", "its manifest is missing or broken")
    parts = key_parts(task)
    if manifest.key == digest_of(parts):
        return State("up to date")
    return State("stale", _difference(manifest, parts))


def state_told(task: Task) -> State:
    """`state_of` for a list that one broken input, or a file that is not there, should not end: it is blocked."""
    try:
        state = state_of(task)
        if state.status == "missing":
            key_parts(task)  # Reads what it would be made of.
        return state
    except BaskError as error:
        return State("blocked", str(error))


def _instead(binding: Binding, path: Path) -> str:
    """Which other variants of a missing input there are, and how to ask for one."""
    if binding.artifact.scope != "dataset" or not binding.artifact.has_variants:
        return ""
    others = sorted(manifest.parent.name for manifest in path.parent.glob(f"*/{MANIFEST}"))
    return f"; there is --{binding.artifact.kind} {', '.join(others)}" if others else ""


def _difference(manifest: Manifest, parts: dict[str, Any]) -> str:
    """What changed since the artifact was made, in words."""
    if manifest.stage_version != parts["version"] or manifest.schema_version != parts["schema"]:
        return f"made by version {manifest.stage_version} of the stage, this is {parts['version']}"
    names = {*manifest.params, *parts["params"]}
    changed = sorted(name for name in names if manifest.params.get(name) != parts["params"].get(name))
    if changed:
        return "changed: " + ", ".join(
            f"{name} {manifest.params.get(name)} -> {parts['params'].get(name)}" for name in changed
        )
    paths = {*manifest.inputs, *parts["inputs"]}
    moved = sorted(path for path in paths if manifest.inputs.get(path) != parts["inputs"].get(path))
    if moved:
        return "changed: " + ", ".join(moved)
    # What is left is in the key alone: the splits, or the content of a file that a parameter names.
    return "changed: " + " or ".join(name for name in ("splits", "files") if name in parts)
