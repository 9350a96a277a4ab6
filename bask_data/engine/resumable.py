"""Scratch directories that survive a kill, for stages that resume."""

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
from bask_data.progress import note


def filled_resumable(task: Task, key: str, fill: Callable[[Path], Manifest], force: bool) -> Manifest:
    """Make an artifact in a scratch directory named by the key, for one process or one torchrun group at a time.

    Raises:
        UsageError: another process is making the artifact, and this group cannot wait for it.
    """
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
                    scratch.rmdir()  # Nothing to resume from if it is empty.
                raise
            for leftover in folder.glob(f"{prefix}*"):
                if leftover.is_dir():
                    shutil.rmtree(leftover, ignore_errors=True)
    except Timeout:
        expected, fix = "no other process making it", "wait until it has finished."
        raise UsageError(task.label, "", expected=expected, got="one that is running", fix=fix) from None
    return manifest


def _acquired(lock: FileLock, task: Task) -> AbstractContextManager[object]:
    """The lock, after waiting for it with a notice."""
    try:
        return lock.acquire()
    except Timeout:
        note(f"{task.label}: waiting for another process that is making it")
        return lock.acquire(timeout=-1)
