"""A dataset's items as one Rerun recording, streamed to disk and renamed into place when complete."""

from __future__ import annotations

import threading
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from bask_data.dataset import Dataset
from bask_data.errors import BaskError, UsageError, WouldOverwrite, imported
from bask_data.view.choice import Choice, Shown
from bask_data.view.item import draw_item
from bask_data.view.layout import layout
from bask_data.view.sheet import FLUSH_SECONDS

if TYPE_CHECKING:
    import rerun as rr

APPLICATION = "bask-data"

SECONDS_TO_ABANDON = 10
"""Seconds that a failed recording gets to close its file."""


def require_rerun() -> None:
    """Raise `MissingDependency` unless Rerun is installed."""
    imported("rerun", "the Rerun SDK", user="view", extra="view")


def save_recording(dataset: Dataset, file: Path, choice: Choice, *, force: bool = False) -> dict[str, Shown]:
    """Write a dataset's items as one recording, frame by frame.

    Args:
        force: replace an existing file, in one step when the new one is complete.

    Returns:
        What is shown of each item.

    Raises:
        MissingDependency: Rerun is not installed.
        WouldOverwrite: the file exists.
        UsageError: none of the items has anything to show, or the file's name does not end in .rrd.
        BadData: an artifact cannot be read, or is inconsistent with the others.
        BaskError: the file cannot be written.
    """
    require_rerun()
    if file.suffix != ".rrd":
        raise UsageError(file, "--save", expected="a name that ends in .rrd", got=file.name)
    if file.is_dir():
        raise UsageError(file, "--save", expected="a file", got="a directory")
    if file.exists() and not force:
        raise WouldOverwrite(file, "", expected="no file", got="one", fix="--force replaces it.")
    file.parent.mkdir(parents=True, exist_ok=True)
    unfinished = file.with_name(f".unfinished.{file.name}")
    try:
        shown = _write(dataset, unfinished, choice)
        unfinished.replace(file)
    except (RuntimeError, OSError) as error:
        fix = "check that the disk has space and that you may write there."
        raise BaskError(
            file, "", expected="a writable file and enough disk space", got=str(error)[:200], fix=fix
        ) from error
    finally:
        with suppress(OSError):
            unfinished.unlink()
    return shown


def _write(dataset: Dataset, file: Path, choice: Choice) -> dict[str, Shown]:
    import rerun as rr

    # Otherwise Rerun only logs what it cannot record, and leaves it out.
    rr.set_strict_mode(True)
    recording = rr.RecordingStream(APPLICATION, recording_id=f"{dataset.file.name}:{','.join(choice.items)}")
    if not rr.is_enabled(recording):
        raise UsageError("RERUN", "environment", expected="on, or not set", got="off", fix="unset RERUN")
    recording.disable_timeline("log_time")
    recording.save(file)
    seconds = SECONDS_TO_ABANDON
    try:
        drawn = {name: draw_item(recording, dataset, name, choice) for name in choice.items}
        shown = [item for item in drawn.values() if item.shown.layers]
        if not shown:
            fix = "bask-data ingest --help"
            asked = ", ".join(choice.items)
            raise UsageError(dataset.root, "", expected="something to show", got=f"nothing of {asked}", fix=fix)
        recording.send_blueprint(layout(shown))
        recording.flush(timeout_sec=FLUSH_SECONDS)
        seconds = FLUSH_SECONDS
    finally:
        is_closed = _closed(recording, seconds)
    if not is_closed:
        raise OSError("Rerun's writer does not finish")
    _check_whole(file)
    return {name: item.shown for name, item in drawn.items()}


def _closed(recording: rr.RecordingStream, seconds: float) -> bool:
    """Close a recording; False if that takes longer than `seconds`.

    Rerun waits forever for its writer, even one that a full disk has killed, and again when the process ends.
    """
    import rerun as rr

    closing = threading.Thread(target=recording.disconnect, daemon=True)
    closing.start()
    closing.join(seconds)
    if closing.is_alive():
        rr.unregister_shutdown()
    return not closing.is_alive()


def _check_whole(file: Path) -> None:
    """Read the file's table of contents back: if the disk fills up at the end, Rerun only logs it."""
    from rerun.chunk import RrdReader

    try:
        n_chunks = len(RrdReader(file).store())
    except ValueError as error:
        raise OSError(f"no table of contents: {error}") from error
    assert n_chunks, "something was drawn"
