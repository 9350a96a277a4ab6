"""Time stamps of files: their unit, recognised and stated, and what no recording can have, refused."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float, Integer
from numpy import ndarray

from bask_data.errors import BadData
from bask_data.formats.files import frame_number

TimeUnit = Literal["auto", "s", "ms", "us", "ns"]
"""Values of the option `--time-unit`."""

PER_SECOND = {"s": 1, "ms": 10**3, "us": 10**6, "ns": 10**9}
"""Stamps per second, by unit, the coarsest first."""

TIME_NAMES = {"s": "seconds", "ms": "milliseconds", "us": "microseconds", "ns": "nanoseconds"}
"""Units of time, in words."""

EPOCH_BEGIN, EPOCH_END = 946_684_800, 4_102_444_800
"""Seconds from 1970 to the years 2000 and 2100: a stamp between them, in one of the units, counts from 1970. No two
units have a number in common."""

SLOWEST = 10.0
"""Median interval, seconds, above which stamps are not in this unit but in the next finer one, where it is 10 ms:
recordings by hand have 1 to 100 frames per second. Chosen, sensitivity not measured."""

UNCERTAIN = 3.0
"""Median interval, seconds, above which nothing but a date tells this unit from the next finer one: 3 to 10 s between
keyframes, or 3 to 10 ms at 100 to 333 frames per second. Chosen, sensitivity not measured."""

LONGEST_GAP = 3600.0
"""Longest interval of a recording, seconds. Chosen, sensitivity not measured."""

LARGEST_COUNT = 10**8
"""Number in a name from which on it is no count of frames, but a date or a time: 38 days at 30 per second."""

NO_OPTION = "write the times in seconds"
"""What to do about a unit that no option states."""

SHORTEST_MEDIAN = 1e-5
"""Shortest median interval of a recording, seconds: no camera takes 100 000 frames per second."""


@dataclass(frozen=True)
class Clock:
    """Times of frames and how they were obtained.

    Args:
        time: seconds on the source's clock, so that several files of one source can be joined.
        statement: the unit and the file, in words, for the assumptions of a recording.
    """

    time: Float[ndarray, " n"]
    statement: str


def seconds(
    values: Float[ndarray, " n"] | Integer[ndarray, " n"],
    where: Path | str,
    lines: Sequence[int] | None = None,
    *,
    unit: TimeUnit = "auto",
    instead: str = "",
    option: str = "--time-unit",
) -> Clock:
    """The stamps in seconds.

    With `auto`, the unit is the one in which the stamps
    1. count from 1970 to a year from 2000 to 2099 and are at most 10 s apart (median), or else
    2. are at most 10 s apart; the coarsest such unit.
    Stamps 0, 1, 2, 3 are seconds, and 33, 66, 100 milliseconds. Refused is what this cannot decide: stamps that are
    more than 3 s apart and do not count from 1970 (5 s between keyframes, or 5 ms at 200 per second), and stamps that
    count from 1970 but are 10 s to an hour apart (or come from a machine that started 11 to 47 days ago, in a finer
    unit). Its limits: keyframes more than 10 s apart that do not count from 1970 are taken for 1000 times faster ones,
    streams of more than 333 per second for 1000 times slower ones, and a single stamp not from 1970 is in seconds. The
    statement says which unit was taken.

    Args:
        values: as in the file. Integers keep their precision: nanoseconds since 1970 exceed that of float64, and are
            rounded (to 0.24 microseconds) only as seconds.
        where: the file, or the name of the stream.
        lines: line of each stamp in the file, from 1, for messages; without them, stamps are counted from 1.
        unit: the unit, if known.
        instead: a way to do without the stamps, which the fix offers, too: "pass --fps without --timestamps".
        option: that states the unit; empty where the format has none.

    Raises:
        BadData: stamps that are not finite or do not increase, an unknown unit, an interval above an hour, or a median
            interval below 10 microseconds.
    """
    stamps = values.astype(np.int64 if np.issubdtype(values.dtype, np.integer) else np.float64)
    _check_increasing(stamps, where, lines, instead)
    taken = _recognised(stamps, where, instead, option) if unit == "auto" else unit
    per_second = PER_SECOND[taken]
    _check_plausible(stamps, taken, where, lines, instead, option)
    time: ndarray
    if stamps.dtype == np.int64:
        whole, rest = np.divmod(stamps, per_second)
        time = whole + rest / per_second
    else:
        time = stamps / per_second
    # Integers that increase may be equal as seconds.
    _check_increasing(time, where, lines, instead, shown=stamps)
    source = where.name if isinstance(where, Path) else where
    origin = " since 1970" if _dated(stamps) == taken else ""
    given = f" ({option} {unit})" if option and unit != "auto" else ""
    return Clock(time, f"{TIME_NAMES[taken]}{origin}, from {source}{given}")


def counted(names: Sequence[str], fps: float) -> Clock:
    """Times of frames that only their number tells: the last one in each name or, unless these increase and are counts,
    the frame's place.

    Args:
        names: of the frames, in their order.
    """
    numbers = [frame_number(name) for name in names]
    known = [number for number in numbers if number is not None]
    # Dates and nanoseconds are no counts of frames.
    if len(known) == len(names) and all(a < b for a, b in pairwise(known)) and max(known, default=0) < LARGEST_COUNT:
        return Clock(np.array(known, dtype=np.float64) / fps, f"frame number / {fps:g} per second")
    return Clock(np.arange(len(names)) / fps, f"place in the sorted list of frames / {fps:g} per second")


def _recognised(stamps: ndarray, where: Path | str, instead: str, option: str) -> str:
    """The unit of increasing stamps; see `seconds`."""
    median = float(np.median(np.diff(stamps))) if len(stamps) > 1 else 0.0
    dated = _dated(stamps)
    if dated and median / PER_SECOND[dated] <= SLOWEST:
        return dated
    by_interval = next((unit for unit, k in PER_SECOND.items() if median / k < SLOWEST), "ns")
    doubtful = None
    if dated and median / PER_SECOND[dated] <= LONGEST_GAP:
        doubtful = (dated, by_interval)
    elif by_interval != "ns" and median / PER_SECOND[by_interval] > UNCERTAIN:
        doubtful = (by_interval, list(PER_SECOND)[list(PER_SECOND).index(by_interval) + 1])
    if doubtful is None:
        return by_interval
    first, second = doubtful
    raise BadData(
        where,
        "time stamps",
        expected="stamps whose unit can be recognised",
        got=f"a median interval of {median:.6g}: {median / PER_SECOND[first]:.3g} s if they are {TIME_NAMES[first]}, "
        f"{median / PER_SECOND[second]:.3g} s if they are {TIME_NAMES[second]}",
        fix=_or(f"pass {option} {first} or {option} {second}" if option else NO_OPTION, instead),
    )


def _dated(stamps: ndarray) -> str | None:
    """The unit in which the stamps, which increase, lie between the years 2000 and 2100; None if there is none."""
    for unit, per_second in PER_SECOND.items():
        if len(stamps) and EPOCH_BEGIN * per_second <= stamps[0] and stamps[-1] < EPOCH_END * per_second:
            return unit
    return None


def _check_increasing(
    stamps: ndarray, where: Path | str, lines: Sequence[int] | None, instead: str, shown: ndarray | None = None
) -> None:
    written = stamps if shown is None else shown
    for i in np.flatnonzero(~np.isfinite(stamps))[:1].tolist():
        raise BadData(
            where,
            _place(i, lines),
            expected="a finite time",
            got=written[i],
            fix=_or("correct the line, or remove it and its frame", instead),
        )
    for i in np.flatnonzero(np.diff(stamps) <= 0)[:1].tolist():
        raise BadData(
            where,
            _place(i + 1, lines),
            expected="times that increase",
            got=f"{written[i + 1]} after {written[i]}",
            fix=_or("sort by time, and remove duplicates together with their frames", instead),
        )


def _check_plausible(
    stamps: ndarray, unit: str, where: Path | str, lines: Sequence[int] | None, instead: str, option: str
) -> None:
    if len(stamps) < 2:
        return
    intervals = np.diff(stamps) / PER_SECOND[unit]
    dated = _dated(stamps)
    looks_like = f"; they look like {TIME_NAMES[dated]} since 1970" if dated not in (None, unit) else ""
    other_unit = f"pass {option} {dated if looks_like else 'with the unit of the stamps'}" if option else NO_OPTION
    median = float(np.median(intervals))
    if median < SHORTEST_MEDIAN:
        raise BadData(
            where,
            "time stamps",
            expected=f"a median interval of at least {SHORTEST_MEDIAN:g} s",
            got=f"{median:.3g} s, read as {TIME_NAMES[unit]}{looks_like}",
            fix=_or(other_unit, instead),
        )
    for i in np.flatnonzero(intervals > LONGEST_GAP)[:1].tolist():
        raise BadData(
            where,
            _place(i + 1, lines),
            expected="at most an hour between frames",
            got=f"{stamps[i + 1]} after {stamps[i]}: {intervals[i]:.3g} s, read as {TIME_NAMES[unit]}{looks_like}",
            fix=_or(
                other_unit if median > LONGEST_GAP else "ingest what is before and after as two recordings", instead
            ),
        )


def _place(i_stamp: int, lines: Sequence[int] | None) -> str:
    return f"line {lines[i_stamp]}" if lines is not None else f"time stamp {i_stamp + 1}"


def _or(fix: str, instead: str) -> str:
    return f"{fix}, or {instead}." if instead else f"{fix}."
