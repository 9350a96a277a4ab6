"""Whether an artifact is up to date: its skip key, and in words what differs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from bask_data.artifact import MANIFEST, digest_of
from bask_data.engine.snapshot import LIVE, Live, Made
from bask_data.engine.tasks import Binding, Task, named_files, parameter_files
from bask_data.errors import BadData, BaskError
from bask_data.kinds import Recording


@dataclass(frozen=True)
class Blocked:
    """Why a task cannot run, and what to do about it.

    Args:
        kind: an input is not there; the dataset has no item to read; an input or its manifest is broken; or a file
            that a parameter names is not there.
        words: for a person.
        fix: a command or an action.
        paths: of the inputs that are not there.
    """

    kind: Literal["input missing", "no items", "input broken", "file missing"]
    words: str
    fix: str
    paths: tuple[Path, ...] = ()


@dataclass(frozen=True)
class State:
    """Whether a task has to run.

    Args:
        why: in words; for `missing` empty, or in a dry run what it comes after.
        blocked: the reason for the status `blocked`, None for every other.
    """

    status: Literal["up to date", "missing", "stale", "blocked"]
    why: str = ""
    blocked: Blocked | None = None


def key_parts(task: Task, seen: Live = LIVE) -> dict[str, Any]:
    """Everything the result depends on; its digest is the skip key.

    Raises:
        BadData: an input has no manifest, or a broken one.
        UsageError: a file that a parameter names does not exist.
    """
    parts = {
        "kind": task.stage.makes.kind,
        "schema": task.stage.makes.schema_version,
        "stage": task.stage.name,
        "version": task.stage.version,
        "params": task.params.model_dump(mode="json"),
        "inputs": {binding.place: seen.made(task.root / binding.place).digest for binding in task.bindings},
    }
    if task.stage.wants_splits:
        parts["splits"] = task.splits.model_dump(mode="json")
    files = {name: _digest_of(task, name, file, seen) for name, file in named_files(task.stage, task.params).items()}
    return {**parts, "files": files} if files else parts


def _digest_of(task: Task, name: str, file: Path, seen: Live) -> str:
    """What a file holds that a parameter names; as it is recorded where it is not there."""
    if not file.is_file() and str(file) in task.recorded_files:
        return task.recorded_files[str(file)]
    return seen.file_digest(parameter_files(task)[name])


def state_of(task: Task, seen: Live = LIVE) -> State:
    """Whether a task has to run, and why.

    Raises:
        BaskError: an input's manifest is broken, or a file that a parameter names does not exist.
    """
    blocked = _lack(task, seen)
    if blocked:
        return State("blocked", blocked.words, blocked)
    if not seen.exists(task.target):
        return State("missing")
    try:
        made = seen.made(task.target)
    except BadData:
        return State("stale", "its manifest is missing or broken")
    parts = key_parts(task, seen)
    if made.key == digest_of(parts):
        return State("up to date", _unseen_files(task))
    return State("stale", _difference(made, parts))


def state_told(task: Task, seen: Live = LIVE) -> State:
    """`state_of` for a list that one broken input, or a file that is not there, should not end: it is blocked."""
    try:
        state = state_of(task, seen)
        if state.status == "missing":
            key_parts(task, seen)  # Reads what it would be made of.
        return state
    except BadData as error:
        return State("blocked", str(error), Blocked("input broken", error.fault, error.fix or "make it again."))
    except BaskError as error:
        words = f"cannot tell whether it is up to date: {error}" if seen.exists(task.target) else str(error)
        return State("blocked", words, Blocked("file missing", error.fault, error.fix))


def _lack(task: Task, seen: Live) -> Blocked | None:
    """What a task would read and is not there."""
    lacking = [binding for binding in task.bindings if not seen.has_manifest(task.root / binding.place)]
    if lacking:
        first = lacking[0]
        fix = "make it first, or `bask-data run`."
        if issubclass(first.artifact, Recording):
            fix = "ingest it again, or `dvc pull`."
        words = f"{first.place} is missing{_instead(task, first)}"
        return Blocked("input missing", words, fix, tuple(task.root / binding.place for binding in lacking))
    for given in task.stage.inputs:
        if task.params.reads(given.artifact.kind) is None and not task.inputs[given.name]:
            is_scene = given.artifact.scope == "scene"
            what = "scenes" if is_scene else given.artifact.kind
            fix = (
                "bask-data ingest FORMAT SOURCE ROOT --scene NAME --as scan" if is_scene else "bask-data ingest --help"
            )
            return Blocked("no items", f"the dataset has no {what}", fix)
    return None


def _instead(task: Task, binding: Binding) -> str:
    """Which other variants of a missing input there are, and how to ask for one."""
    if binding.artifact.scope != "dataset" or not binding.artifact.has_variants:
        return ""
    folder = (task.root / binding.place).parent
    others = sorted(manifest.parent.name for manifest in folder.glob(f"*/{MANIFEST}"))
    return f"; there is --{binding.artifact.kind} {', '.join(others)}" if others else ""


def _unseen_files(task: Task) -> str:
    """Files that this machine lacks and the result depends on, in words."""
    files = [file for file in named_files(task.stage, task.params).values() if not file.is_file()]
    return f"{', '.join(map(str, files))} is not there; compared with what is recorded of it" if files else ""


def _difference(made: Made, parts: dict[str, Any]) -> str:
    """What changed since the artifact was made, in words."""
    if made.stage_version != parts["version"] or made.schema_version != parts["schema"]:
        return f"made by version {made.stage_version} of the stage, this is {parts['version']}"
    names = {*made.params, *parts["params"]}
    changed = sorted(name for name in names if made.params.get(name) != parts["params"].get(name))
    if changed:
        return "changed: " + ", ".join(
            f"{name} {made.params.get(name)} -> {parts['params'].get(name)}" for name in changed
        )
    paths = {*made.inputs, *parts["inputs"]}
    moved = sorted(path for path in paths if made.inputs.get(path) != parts["inputs"].get(path))
    if moved:
        return "changed: " + ", ".join(moved)
    # What is left is in the key alone: the splits, or the content of a file that a parameter names.
    return "changed: " + " or ".join(name for name in ("splits", "files") if name in parts)
