"""A dataset's items as one Rerun recording, written while it is drawn and replaced in one step."""

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
"""What a recording that failed gets to close its file."""


def require_rerun() -> None:
    """Refuse to begin without the package; `MissingDependency`."""
    imported("rerun", "the Rerun SDK", user="view", extra="view")


def save_recording(dataset: Dataset, file: Path, choice: Choice, *, force: bool = False) -> dict[str, Shown]:
    """Write a dataset's items as one recording; frames go to the file as they come.

    Args:
        force: replace a file of that name. It is replaced in one step, when the new one is whole.

    Returns:
        What was shown of each item.

    Raises:
        MissingDependency: Rerun is not installed.
        WouldOverwrite: the file exists.
        UsageError: none of the items has anything to show, or the file's name is not one the viewer opens.
        BadData: an artifact cannot be read, or does not fit the others.
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
        fix = "see that the disk has room."
        raise BaskError(file, "", expected="a file that takes all", got=str(error)[:200], fix=fix) from error
    finally:
        with suppress(OSError):
            unfinished.unlink()
    return shown


def _write(dataset: Dataset, file: Path, choice: Choice) -> dict[str, Shown]:
    import rerun as rr

    # Else Rerun answers what it cannot take with a line in the log, and leaves it out of the recording.
    rr.set_strict_mode(True)
    recording = rr.RecordingStream(APPLICATION, recording_id=f"{dataset.file.name}:{','.join(choice.items)}")
    if not rr.is_enabled(recording):
        raise UsageError("RERUN", "environment", expected="on, or not set", got="off", fix="unset RERUN")
    recording.disable_timeline("log_time")
    recording.save(file)
    seconds = SECONDS_TO_ABANDON
    try:
        drawn = {name: draw_item(recording, dataset, name, choice) for name in choice.items}
        shown = [one for one in drawn.values() if one.shown.layers]
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
        raise OSError("Rerun's writer does not come to an end")
    _check_whole(file)
    return {name: one.shown for name, one in drawn.items()}


def _closed(recording: rr.RecordingStream, seconds: float) -> bool:
    """Close a recording; False when that does not end. Rerun waits for its writer for ever, even one that a full disk
    has killed, and would do so again when the process ends."""
    import rerun as rr

    closing = threading.Thread(target=recording.disconnect, daemon=True)
    closing.start()
    closing.join(seconds)
    if closing.is_alive():
        rr.unregister_shutdown()
    return not closing.is_alive()


def _check_whole(file: Path) -> None:
    """Read the file's table of contents back: a disk that is full at the end is a line in Rerun's log, no error."""
    from rerun.chunk import RrdReader

    try:
        n_chunks = len(RrdReader(file).store())
    except ValueError as error:
        raise OSError(f"no table of contents: {error}") from error
    assert n_chunks, "something was drawn"
