"""Scratch directories that outlive a kill, for stages that go on where they were."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from contextlib import AbstractContextManager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

from bask_data.artifact import Manifest, read_manifest
from bask_data.engine.group import processes
from bask_data.engine.state import state_of
from bask_data.engine.tasks import Task
from bask_data.errors import UsageError
from bask_data.progress import tell


def filled_resumable(task: Task, key: str, fill: Callable[[Path], Manifest], force: bool) -> Manifest:
    """Run with a scratch directory named by the key, for one process at a time, or one group of them."""
    scratch = task.resumable_scratch(key)
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
