"""Stages: one function that makes one kind of artifact. Everything else is read off its signature.

A parameter annotated with a kind is an input: of the same item if the kind has the stage's scope, the dataset's one if
the kind belongs to the dataset, and all items' if it is `list[Kind]`. Parameters may do without some (`Params.reads`);
a single input that may be missing so is annotated `Kind | None`. `params` holds what changes the result, `out` is
the empty directory to fill, `Splits` gives the dataset's splits; `log`, if it is asked for, is a directory outside the
artifact for what differs from run to run. Exactly one stage makes a kind, so the graph needs no names.
"""

from __future__ import annotations

import getpass
import importlib
import os
import platform
import shutil
import socket
import sys
import time
import types
import typing
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor, as_completed
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

from filelock import FileLock, Timeout
from pydantic import ValidationError

from bask_data import __version__
from bask_data.artifact import (
    MANIFEST,
    SCRATCH,
    Artifact,
    Manifest,
    digest_of,
    file_digest,
    new_scratch,
    publish,
    read_manifest,
    seal,
    write_json_atomically,
)
from bask_data.dataset import Dataset, Splits, Variant, check_name
from bask_data.errors import BadData, BaskError, UsageError
from bask_data.params import Params, first_fault
from bask_data.progress import progress, report, tell

__all__ = [
    "Config",
    "Outcome",
    "Params",
    "Splits",
    "Stage",
    "State",
    "Task",
    "follow",
    "in_order",
    "is_follower",
    "key_parts",
    "make",
    "plan",
    "processes",
    "progress",
    "record",
    "resolve",
    "run",
    "stage",
    "state_of",
]

RUNS = "runs"
"""Folder of a dataset where stages log what differs from run to run, as `provenance` tells who made what."""

Config = dict[str, dict[str, Any]]
"""Parameters by section: the name of a stage, or `stage@name` for one item or variant."""


@dataclass(frozen=True)
class Input:
    """An input of a stage. `gather`: a list over all items of the kind's scope."""

    name: str
    artifact: type[Artifact]
    gather: bool


@dataclass(frozen=True)
class Stage:
    """A declared stage; call it like the function it was made from."""

    name: str
    makes: type[Artifact]
    version: int
    resumable: bool
    together: bool
    params: type[Params]
    inputs: tuple[Input, ...]
    wants_splits: bool
    function: Callable[..., None]
    help: str

    def __call__(self, *args: Any, **kwargs: Any) -> None:
        self.function(*args, **kwargs)

    def __reduce__(self) -> tuple[Any, ...]:
        # A stage crosses processes by name: its module holds it under the function's name.
        return _load_stage, (self.function.__module__, self.function.__name__)


def _load_stage(module: str, name: str) -> Stage:
    return getattr(importlib.import_module(module), name)


def stage(
    *, makes: type[Artifact], version: int, resumable: bool = False, together: bool = False
) -> Callable[[Callable[..., None]], Stage]:
    """Declare a function as the stage that makes a kind.

    Args:
        version: raise it by hand when the results change; it is part of the skip key.
        resumable: after a kill, `out` still holds what the last attempt wrote with the same key.
        together: several processes, started by torchrun, can make one artifact. All are called; the first writes.
    """

    def declare(function: Callable[..., None]) -> Stage:
        hints = typing.get_type_hints(function)
        inputs, params, wants_splits = [], Params, False
        for name, hint in hints.items():
            if name in ("out", "log", "return"):
                continue
            if hint is Splits:
                wants_splits = True
            elif typing.get_origin(hint) is list:
                inputs.append(Input(name, typing.get_args(hint)[0], gather=True))
            elif isinstance(hint, types.UnionType):
                inputs.append(Input(name, typing.get_args(hint)[0], gather=False))
            elif issubclass(hint, Artifact):
                inputs.append(Input(name, hint, gather=False))
            else:
                assert issubclass(hint, Params), f"{function.__name__}: {name} is no input, Params or Splits"
                params = hint
        return Stage(
            name=function.__name__,
            makes=makes,
            version=version,
            resumable=resumable,
            together=together,
            params=params,
            inputs=tuple(inputs),
            wants_splits=wants_splits,
            function=function,
            help=(function.__doc__ or "").strip(),
        )

    return declare


@dataclass(frozen=True)
class Binding:
    """One artifact that a task reads."""

    artifact: type[Artifact]
    item: str
    variant: str


@dataclass(frozen=True)
class Task:
    """One artifact to make: a stage, an item, a variant and resolved parameters. Picklable and idempotent."""

    root: Path
    stage: Stage
    item: str
    variant: str
    params: Params
    inputs: dict[str, tuple[Binding, ...]]
    splits: Splits

    @property
    def dataset(self) -> Dataset:
        return Dataset(self.root)

    @property
    def target(self) -> Path:
        """Where the artifact lies or will lie."""
        return self.dataset.path(self.stage.makes, self.item, self.variant)

    @property
    def label(self) -> str:
        """The task in words: stage, variant unless it is `main`, item."""
        parts = [self.stage.name, self.variant if self.variant != "main" else "", self.item]
        return " ".join(part for part in parts if part)

    def input_path(self, binding: Binding) -> Path:
        """Where an input lies."""
        return self.dataset.path(binding.artifact, binding.item, binding.variant)

    @property
    def input_paths(self) -> list[Path]:
        """Where all of them lie, in order."""
        return [self.input_path(binding) for bindings in self.inputs.values() for binding in bindings]


@dataclass(frozen=True)
class State:
    """Whether a task has to run.

    Args:
        status: `blocked` when an input is missing.
        why: in words, for `missing` empty, or foretold what it comes after.
    """

    status: Literal["up to date", "missing", "stale", "blocked"]
    why: str = ""


@dataclass(frozen=True)
class Outcome:
    """What became of a task."""

    label: str
    kind: str
    item: str
    variant: str
    path: str
    status: Literal["made", "up to date", "failed", "blocked", "would make"]
    why: str = ""
    seconds: float = 0.0
    digest: str = ""
    error: BaskError | None = None


def in_order(stages: Iterable[Stage]) -> list[Stage]:
    """The stages sorted so that each comes after those that make its inputs."""
    waiting, ordered = list(stages), []
    while waiting:
        unmade = {stage.makes for stage in waiting}
        ready = [stage for stage in waiting if not unmade & {given.artifact for given in stage.inputs}]
        assert ready, "the stages form a cycle"
        ordered += ready
        waiting = [stage for stage in waiting if stage not in ready]
    return ordered


def resolve(stage: Stage, config: Config, item: str, variant: str, options: dict[str, Any]) -> Params:
    """The parameters of one task: options over `stage@item` over `stage@variant` over `stage` over defaults."""
    values: dict[str, Any] = {}
    sections = [stage.name, f"{stage.name}@{variant}", f"{stage.name}@{item}"]
    for section in sections:
        values.update(config.get(section) or {})
    values.update(options)
    try:
        return stage.params.model_validate(values)
    except ValidationError as error:
        field, expected, came = first_fault(error)
        known = ", ".join(stage.params.model_fields)
        fix = (
            f"see `bask-data {stage.name} --help`."
            if field.split(".")[0] in stage.params.model_fields
            else f"one of {known}."
        )
        raise UsageError(stage.name, field, expected=expected, got=came, fix=fix) from error


def plan(
    dataset: Dataset,
    stage: Stage,
    *,
    config: Config | None = None,
    options: dict[str, Any] | None = None,
    only: Sequence[str] = (),
    variant: str = "main",
    variant_inputs: dict[str, str] | None = None,
) -> list[Task]:
    """The tasks of a stage: one an item, or one for the dataset.

    Args:
        only: names of items; empty means all.
        variant_inputs: variant of each input kind that has them; else as `dataset.json` says, else `variant`.
    """
    makes = stage.makes
    items = dataset.items(makes.scope) if makes.scope != "dataset" else [""]
    unknown = [name for name in only if name not in items]
    if unknown and makes.scope != "dataset":
        raise UsageError(
            dataset.root, "--only", expected=f"one of {', '.join(items) or 'no items yet'}", got=", ".join(unknown)
        )
    recorded = dataset.variants(makes).get(variant, Variant()).inputs
    chosen = {**recorded, **(variant_inputs or {})}
    # They become names of folders, and what stands in a target's place is replaced.
    for name in (variant, *chosen.values()):
        check_name(name, dataset.root)
    _refuse_unknown_sections(dataset, stage, config or {}, variant)
    tasks = []
    for item in items:
        if only and makes.scope != "dataset" and item not in only:
            continue
        params = resolve(stage, config or {}, item, variant, options or {})
        inputs = {
            given.name: tuple(
                Binding(
                    given.artifact,
                    name,
                    chosen.get(given.artifact.kind, variant) if given.artifact.has_variants else "main",
                )
                for name in _items_of(dataset, given, item, params)
            )
            for given in stage.inputs
        }
        tasks.append(
            Task(
                root=dataset.root,
                stage=stage,
                item=item,
                variant=variant,
                params=params,
                inputs=inputs,
                splits=dataset.file.splits if stage.wants_splits else Splits(),
            )
        )
    return tasks


def _refuse_unknown_sections(dataset: Dataset, stage: Stage, config: Config, variant: str) -> None:
    """A section `stage@name` for a name that does not exist is most likely misspelt, and would not count."""
    items = dataset.items(stage.makes.scope) if stage.makes.scope != "dataset" else []
    known = dict.fromkeys([*items, *dataset.variants(stage.makes), variant])
    for section in config:
        name, _, of = section.partition("@")
        if name == stage.name and of and of not in known:
            raise UsageError(section, "", expected=f"{name}@ and one of {', '.join(known)}", got=of)


def _items_of(dataset: Dataset, given: Input, item: str, params: Params) -> list[str]:
    read = params.reads(given.artifact.kind)
    if given.gather:
        items = dataset.items(given.artifact.scope)
        if given.artifact.scope == "recording":
            # No stage makes what belongs to recordings: their source brings it, or there is none.
            sources, kind = {**dataset.file.scenes, **dataset.file.demonstrations}, given.artifact
            items = [name for name in items if sources[name].truth or (dataset.path(kind, name) / MANIFEST).exists()]
        return [name for name in items if read is None or name in read]
    if read == ():
        return []
    return [""] if given.artifact.scope == "dataset" else [item]


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


def parameter_files(task: Task) -> dict[str, Path]:
    """Files that parameters name, by parameter: what they hold is part of the key.

    Such a field is declared with `json_schema_extra={"file": True}`.

    Raises:
        UsageError: a file does not exist.
    """
    found = {}
    for name, field in task.stage.params.model_fields.items():
        value = getattr(task.params, name)
        if isinstance(field.json_schema_extra, dict) and field.json_schema_extra.get("file") and value:
            found[name] = Path(value)
            if not found[name].is_file():
                raise UsageError(task.stage.name, name, expected="a file", got=str(value), fix="check the path.")
    return found


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


def state_told(task: Task) -> State:
    """`state_of` for a list that one broken input, or a file that is not there, should not end: it is blocked."""
    try:
        state = state_of(task)
        if state.status == "missing":
            key_parts(task)  # Reads what it would be made of.
        return state
    except BaskError as error:
        return State("blocked", str(error))


def make(task: Task, force: bool = False) -> Outcome:
    """Make one artifact unless it is up to date. Errors come back in the outcome, so that other items go on."""
    begun = time.perf_counter()
    path = str(task.target)
    outcome = Outcome(task.label, task.stage.makes.kind, task.item, task.variant, path, "made")
    try:
        state = state_of(task)
        if state.status == "blocked":
            return replace(outcome, status="blocked", why=state.why)
        if state.status == "up to date" and not force:
            return replace(outcome, status="up to date", digest=read_manifest(task.target).digest)
        manifest = _make(task, begun, force)
    except BaskError as error:
        return replace(
            outcome, status="failed", why=_with_notes(error), seconds=time.perf_counter() - begun, error=error
        )
    except ImportError:
        raise
    except Exception as error:
        # An input that a stage did not expect, or a full disk: other items go on, and it is said which one it was.
        if os.environ.get("BASK_DEBUG"):
            raise
        why = f"{path}: {type(error).__name__}: {error}  fix: `bask-data validate`, or BASK_DEBUG=1 for the traceback."
        return replace(outcome, status="failed", why=why, seconds=time.perf_counter() - begun)
    return replace(outcome, seconds=time.perf_counter() - begun, digest=manifest.digest, why=state.why)


def _with_notes(error: BaskError) -> str:
    return "\n".join([str(error), *getattr(error, "__notes__", [])])


def _arguments(task: Task) -> dict[str, Any]:
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


def _make(task: Task, begun: float, force: bool) -> Manifest:
    parts = key_parts(task)
    key = digest_of(parts)
    arguments = _arguments(task)
    task.dataset.prepare(task.stage.makes, task.variant)

    def fill(scratch: Path) -> Manifest:
        task.stage.function(**arguments, out=scratch)
        manifest = seal(
            scratch,
            artifact=task.stage.makes,
            stage=task.stage.name,
            stage_version=task.stage.version,
            params=parts["params"],
            inputs=parts["inputs"],
            key=key,
        )
        publish(scratch, task.target)
        return manifest

    if task.stage.resumable:
        manifest = _fill_resumable(task, key, fill, force)
    else:
        scratch = new_scratch(task.root, task.stage.makes.kind)
        try:
            manifest = fill(scratch)
        finally:
            shutil.rmtree(scratch, ignore_errors=True)
    record(task.root, task.target, begun, manifest.key)
    return manifest


def _resumed(task: Task, key: str) -> Path:
    """The scratch directory that a kill leaves in place."""
    return task.root / SCRATCH / f"resume~{task.stage.makes.kind}~{task.variant}~{task.item}~{key[:32]}"


def _fill_resumable(task: Task, key: str, fill: Callable[[Path], Manifest], force: bool) -> Manifest:
    """Run with a scratch directory named by the key, for one process at a time, or one group of them."""
    scratch = _resumed(task, key)
    folder, prefix = scratch.parent, scratch.name.removesuffix(key[:32])
    folder.mkdir(exist_ok=True)
    lock = FileLock(folder / f"{prefix}.lock", timeout=0)
    try:
        with _acquired(lock, task) if processes() == 1 else lock:
            if not force and state_of(task).status == "up to date":
                # Another process made it while this one waited for the lock.
                return read_manifest(task.target)
            scratch.mkdir(exist_ok=True)
            try:
                manifest = fill(scratch)
            except BaseException:
                with suppress(OSError):
                    scratch.rmdir()  # Where nothing was left in it, there is nothing to go on from.
                raise
            for left in folder.glob(f"{prefix}*"):
                if left.is_dir():
                    shutil.rmtree(left, ignore_errors=True)
    except Timeout:
        fix = "wait until that has ended."
        raise UsageError(task.label, "", expected="nobody else to make it", got="another process", fix=fix) from None
    return manifest


def _acquired(lock: FileLock, task: Task) -> AbstractContextManager[object]:
    """The lock, whenever it is free; that it is waited for is told. A group does not: its others wait for its first."""
    try:
        return lock.acquire()
    except Timeout:
        tell(f"{task.label}: another process is making it; this one waits until that has ended")
        return lock.acquire(timeout=-1)


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
        task.stage.function(**_arguments(task), out=_resumed(task, digest_of(key_parts(task))))


def record(root: Path, target: Path, begun: float, key: str) -> None:
    """Write who made an artifact, when, where and at what cost; outside it, so that no digest depends on it."""
    relative = target.relative_to(root)
    write_json_atomically(
        root / "provenance" / relative.parent / f"{relative.name}.json",
        {
            "key": key,
            "user": _user(),
            "host": socket.gethostname(),
            "time": datetime.now(UTC).isoformat(timespec="seconds"),
            "seconds": round(time.perf_counter() - begun, 3),
            "process_peak_bytes": _peak_bytes(),
            "bask_data": __version__,
            "python": platform.python_version(),
            "platform": platform.platform(),
            "packages": {
                name: str(getattr(sys.modules[name], "__version__", ""))
                for name in ("numpy", "open3d", "torch", "zarr", "sklearn", "cv2")
                if name in sys.modules
            },
        },
    )


def _user() -> str:
    try:
        return getpass.getuser()
    except (KeyError, OSError):
        return str(os.getuid())


def _peak_bytes() -> int:
    try:
        # Not `ru_maxrss`, which a process begins with its parent's peak.
        line = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM"))
        return int(line.split()[1]) * 1024
    except (OSError, StopIteration):
        import resource

        # macOS counts in bytes, others in kibibytes.
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return peak if sys.platform == "darwin" else peak * 1024


def foretold(tasks: Sequence[Task], coming: set[Path], force: bool = False) -> Iterator[Outcome]:
    """What `run` would do, and why.

    Args:
        coming: paths of what earlier stages would make; what these tasks would is added.
    """
    for task in tasks:
        state = state_told(task)
        lacking = [path for path in task.input_paths if not (path / MANIFEST).exists()]
        if state.status == "blocked" and lacking and coming.issuperset(lacking):
            state = State("missing", f"after {', '.join(path.relative_to(task.root).as_posix() for path in lacking)}")
        would = state.status in ("missing", "stale") or (force and state.status == "up to date")
        if would:
            coming.add(task.target)
        status: Any = "would make" if would else state.status
        yield Outcome(task.label, task.stage.makes.kind, task.item, task.variant, str(task.target), status, state.why)


def run(tasks: Sequence[Task], *, executor: Executor | None = None, force: bool = False) -> Iterator[Outcome]:
    """Make what is not up to date, here or on any executor, and yield outcomes as they come."""
    if executor is None:
        for task in tasks:
            yield make(task, force)
        return
    futures = [executor.submit(make, task, force) for task in tasks]
    label = tasks[0].stage.name if tasks else ""
    try:
        for done, future in enumerate(as_completed(futures), start=1):
            report(label, done, len(futures))
            yield future.result()
    except BaseException:
        for future in futures:
            future.cancel()
        raise
