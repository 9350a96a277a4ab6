"""Whether an artifact is up to date: its skip key, and what differs."""

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
    """Why a task cannot run, and the fix.

    Args:
        kind: an input is missing; the dataset has no item to read; an input or its manifest is damaged; or a file that
            a parameter names is missing.
        words: the reason as a sentence.
        fix: a command or an action.
        paths: paths of the missing inputs.
    """

    kind: Literal["input missing", "no items", "input broken", "file missing"]
    words: str
    fix: str
    paths: tuple[Path, ...] = ()


@dataclass(frozen=True)
class State:
    """Whether a task has to run.

    Args:
        why: the reason in words; for `missing` empty, or in a dry run the inputs that are made before.
        blocked: the reason for the status `blocked`, otherwise None.
    """

    status: Literal["up to date", "missing", "stale", "blocked"]
    why: str = ""
    blocked: Blocked | None = None


def key_parts(task: Task, seen: Live = LIVE) -> dict[str, Any]:
    """Everything the result depends on; its digest is the skip key.

    Raises:
        BadData: an input's manifest is missing or damaged.
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
    """SHA-256 of a file that a parameter names; the recorded one if the file is missing."""
    if not file.is_file() and str(file) in task.recorded_files:
        return task.recorded_files[str(file)]
    return seen.file_digest(parameter_files(task)[name])


def state_of(task: Task, seen: Live = LIVE) -> State:
    """Whether a task has to run, and why.

    Raises:
        BaskError: an input's manifest is damaged, or a file that a parameter names does not exist.
    """
    blocked = _lack(task, seen)
    if blocked:
        return State("blocked", blocked.words, blocked)
    if not seen.exists(task.target):
        return State("missing")
    try:
        made = seen.made(task.target)
    except BadData:
        return State("stale", "its manifest is missing or damaged")
    parts = key_parts(task, seen)
    if made.key == digest_of(parts):
        return State("up to date", _unseen_files(task))
    return State("stale", _difference(made, parts))


def state_or_blocked(task: Task, seen: Live = LIVE) -> State:
    """`state_of`, with an error about an input or a named file as the state `blocked`, for lists of many tasks."""
    try:
        state = state_of(task, seen)
        if state.status == "missing":
            key_parts(task, seen)  # Reads the inputs.
        return state
    except BadData as error:
        return State("blocked", str(error), Blocked("input broken", error.fault, error.fix or "make it again."))
    except BaskError as error:
        words = f"unknown whether it is up to date: {error}" if seen.exists(task.target) else str(error)
        return State("blocked", words, Blocked("file missing", error.fault, error.fix))


def _lack(task: Task, seen: Live) -> Blocked | None:
    """The missing input of a task, if there is one."""
    missing = [binding for binding in task.bindings if not seen.has_manifest(task.root / binding.place)]
    if missing:
        first = missing[0]
        fix = "make it first, or use `bask-data run` without --only."
        if issubclass(first.artifact, Recording):
            fix = "ingest it again, or `dvc pull`."
        words = f"{first.place} is missing{_instead(task, first)}"
        return Blocked("input missing", words, fix, tuple(task.root / binding.place for binding in missing))
    for input_ in task.stage.inputs:
        if task.params.reads(input_.artifact.kind) is None and not task.inputs[input_.name]:
            is_scene = input_.artifact.scope == "scene"
            what = "scenes" if is_scene else input_.artifact.kind
            fix = (
                "bask-data ingest FORMAT SOURCE ROOT --scene NAME --as scan" if is_scene else "bask-data ingest --help"
            )
            return Blocked("no items", f"the dataset has no {what}", fix)
    return None


def _instead(task: Task, binding: Binding) -> str:
    """The existing variants of a missing input, as the option that selects them."""
    if binding.artifact.scope != "dataset" or not binding.artifact.has_variants:
        return ""
    folder = (task.root / binding.place).parent
    others = sorted(manifest.parent.name for manifest in folder.glob(f"*/{MANIFEST}"))
    return f"; there is --{binding.artifact.kind} {', '.join(others)}" if others else ""


def _unseen_files(task: Task) -> str:
    """A note on files that the result depends on and that are missing here."""
    files = [file for file in named_files(task.stage, task.params).values() if not file.is_file()]
    return f"{', '.join(map(str, files))} is missing; compared with its recorded SHA-256" if files else ""


def _difference(made: Made, parts: dict[str, Any]) -> str:
    """What has changed since the artifact was made, in words."""
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
    # Only the key covers the rest: the splits, and the content of files that parameters name.
    return "changed: " + " or ".join(name for name in ("splits", "files") if name in parts)
