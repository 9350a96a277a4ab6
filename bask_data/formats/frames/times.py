"""Times of the frames of `ingest frames`: stated in a file or in names, or made from the frames' numbers."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from jaxtyping import Float
from numpy import ndarray

from bask_data.errors import BadData
from bask_data.formats.clock import counted, seconds
from bask_data.formats.files import Folder, is_number, numbered_lines, numbers
from bask_data.formats.options.frames import FramesOptions
from bask_data.formats.trajectory_files import stamps_of

BY_NAME = "name"
"""Value of `--timestamps` with which the files' names are the times."""


@dataclass(frozen=True)
class FrameTimes:
    """Times of the frames.

    Args:
        time: seconds.
        statement: how they were obtained, in words.
        files: the files that state them.
        stated: whether they are times of the source, which poses can be looked up at.
    """

    time: Float[ndarray, " t"]
    statement: str
    files: tuple[Path, ...] = ()
    stated: bool = False


def in_order_of_time(names: list[str]) -> list[str]:
    """Names that are times in the order of these; `natural` order takes 12.5 for less than 12.25."""
    try:
        return sorted(names, key=float)
    except ValueError:
        return names


def frame_times(folder: Folder, names: list[str], options: FramesOptions) -> FrameTimes:
    """Times of the frames of a camera, as the options say.

    Raises:
        BadData: the file or the names state no times that a recording can have.
    """
    instead = "pass --fps without --timestamps"
    if options.timestamps == BY_NAME:
        clock = seconds(_stamps_of_names(folder.path, names), "files' names", unit=options.time_unit, instead=instead)
        return FrameTimes(clock.time, clock.statement, stated=True)
    if options.timestamps:
        path = Path(options.timestamps)
        path = path if path.is_file() else folder.member(options.timestamps, "--timestamps")
        lines = numbered_lines(path)
        if len(lines) == len(names) + 1 and not is_number(lines[0][1]):
            lines = lines[1:]  # The name of the column.
        counts = [len(numbers(path, line)) for _, line in lines]
        odd = next((f"{i}, {line[:40]!r}" for (i, line), n in zip(lines, counts, strict=True) if n != 1), None)
        if len(lines) != len(names) or odd is not None:
            raise BadData(
                path,
                "--timestamps",
                expected=f"{len(names)} lines of one time each",
                got=f"{len(lines)} lines" + ("" if odd is None else f", of several numbers: line {odd}"),
                fix=f"write a line for each of the {len(names)} frames, or {instead}.",
            )
        stamps = stamps_of([line.strip(" ,;") for _, line in lines])
        clock = seconds(stamps, path, [i for i, _ in lines], unit=options.time_unit, instead=instead)
        return FrameTimes(clock.time, clock.statement, (path,), stated=True)
    clock = counted(names, options.fps)
    return FrameTimes(clock.time, clock.statement)


def _stamps_of_names(source: Path, names: list[str]) -> ndarray:
    try:
        return stamps_of(names)
    except ValueError:
        odd = next(name for name in names if not name.replace(".", "", 1).isdecimal())
        raise BadData(
            source,
            "--timestamps name",
            expected="* to match a time in seconds",
            got=repr(odd),
            fix="change the patterns so that * matches just the time, or pass --fps.",
        ) from None
