from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bask_data.errors import BadData
from bask_data.formats.clock import PER_SECOND, TIME_NAMES, TimeUnit, counted, seconds

TIMES = Path("recording/times.txt")
NOVEMBER_2020 = 1_604_644_894


@pytest.mark.parametrize("unit", PER_SECOND)
@pytest.mark.parametrize("whole", [True, False])
def test_stamps_since_1970_are_recognised_in_any_unit(unit: str, whole: bool) -> None:
    exact = NOVEMBER_2020 + np.arange(20) / (1 if unit == "s" and whole else 30)
    stamps = (NOVEMBER_2020 * PER_SECOND[unit] + np.rint((exact - NOVEMBER_2020) * PER_SECOND[unit])).astype(np.int64)
    clock = seconds(stamps if whole else exact * PER_SECOND[unit], TIMES)
    assert clock.statement == f"{TIME_NAMES[unit]} since 1970, from times.txt"
    assert np.abs(clock.time - exact).max() < (6e-4 if unit == "ms" and whole else 1e-6)


@pytest.mark.parametrize(
    ("stamps", "unit"),
    [
        ([0, 1, 2, 3], "s"),
        ([0, 2, 4, 6], "s"),
        ([0.0, 0.033, 0.066, 0.1], "s"),
        ([3000.0, 3000.4, 3000.8], "s"),
        ([-0.2, -0.1, 0.0], "s"),
        ([33, 66, 100], "ms"),
        ([0, 11, 22, 33], "ms"),  # 90 per second
        ([5000, 6000, 7000], "ms"),  # one per second
        ([33_000, 66_000, 100_000], "us"),
        ([10**9, 2 * 10**9 - 1], "ns"),
        ([33_333_333, 66_666_666, 99_999_999], "ns"),
        # Since the machine started: in another unit they would be dates, but hours apart.
        ([2_000_000_000, 2_033_333_333, 2_066_666_666], "ns"),
        ([1_000_000_000_000, 1_000_033_333_333, 1_000_066_666_666], "ns"),
        ([1_000_000_000, 1_000_033_333, 1_000_066_666], "us"),
        # Unix time with keyframes 5 s apart: the date decides.
        ([1_700_000_000, 1_700_000_005, 1_700_000_010], "s"),
        # A frame or two left out.
        ([0, 33, 67, 100, 5100, 5133, 5167, 5200], "ms"),
        ([12.5], "s"),
    ],
)
def test_the_unit_follows_from_the_interval_where_no_date_tells_it(stamps: list[float], unit: str) -> None:
    clock = seconds(np.array(stamps), "the stream")
    assert clock.time == pytest.approx(np.array(stamps) / PER_SECOND[unit], rel=1e-15)
    assert clock.statement.removesuffix(", from the stream").removesuffix(" since 1970") == TIME_NAMES[unit]


@given(
    begin=st.integers(10**18, 2 * 10**18),
    steps=st.lists(st.integers(10**6, 10**9), min_size=2, max_size=30),
)
def test_whole_nanoseconds_are_rounded_once_and_to_the_nearest_second_a_float_can_hold(
    begin: int, steps: list[int]
) -> None:
    stamps = np.cumsum([begin, *steps])
    time = seconds(stamps, TIMES).time
    # Python divides integers exactly, and rounds once.
    assert np.abs(time - np.array([int(stamp) / 10**9 for stamp in stamps])).max() <= np.spacing(2e9)


def test_unsigned_stamps_that_decrease_are_noticed() -> None:
    with pytest.raises(BadData, match="time stamp 2: expected times that increase, got 5 after 9"):
        seconds(np.array([9, 5], np.uint64), TIMES)


@pytest.mark.parametrize(
    ("stamps", "apart"),
    [
        ([0, 5, 10], "5 s if they are seconds, 0.005 s if they are milliseconds"),
        ([0, 5000, 10_000], "5 s if they are milliseconds, 0.005 s if they are microseconds"),
        ([0, 5 * 10**6, 10**7], "5 s if they are microseconds, 0.005 s if they are nanoseconds"),
        # Unix time and a frame every 33 s, or milliseconds since the machine started 18 days ago.
        ([1_600_000_000, 1_600_000_033, 1_600_000_066], "33 s if they are seconds, 0.033 s if they are milliseconds"),
    ],
)
def test_units_that_cannot_be_told_apart_are_asked_for_and_the_answer_is_taken(stamps: list[int], apart: str) -> None:
    with pytest.raises(
        BadData, match=f"times.txt: time stamps: .* recognised, got a median interval .*: {apart}"
    ) as told:
        seconds(np.array(stamps), TIMES)
    units: list[TimeUnit] = [unit for unit in ("s", "ms", "us", "ns") if f"--time-unit {unit}" in told.value.fix]
    assert len(units) == 2
    for unit in units:
        clock = seconds(np.array(stamps), TIMES, unit=unit)
        assert clock.time == pytest.approx(np.array(stamps) / PER_SECOND[unit])
        assert clock.statement.startswith(TIME_NAMES[unit])
        assert clock.statement.endswith(f", from times.txt (--time-unit {unit})")


def test_a_stated_unit_overrides_what_the_stamps_look_like() -> None:
    assert seconds(np.array([33, 66, 100]), TIMES, unit="s").time.tolist() == [33, 66, 100]


def test_times_that_do_not_increase_are_named_with_their_line_and_a_way_without_them() -> None:
    stamps = np.array([100.0, 100.0, 100.066, 100.066])
    with pytest.raises(
        BadData, match="recording/times.txt: line 4: expected times that increase, got 100.0 after 100.0"
    ) as told:
        seconds(stamps, TIMES, [3, 4, 6, 7], instead="pass --fps without --timestamps")
    assert told.value.fix == (
        "sort by time, and remove duplicates together with their frames, or pass --fps without --timestamps."
    )
    with pytest.raises(BadData, match="time stamp 3: expected times that increase, got 0.2 after 0.3") as told:
        seconds(np.array([0.0, 0.3, 0.2]), TIMES)
    assert told.value.fix == "sort by time, and remove duplicates together with their frames."


def test_nanoseconds_that_are_one_float_as_seconds_are_refused_as_written() -> None:
    begin = NOVEMBER_2020 * 10**9
    stamps = begin + np.array([0, 33_333_333, 33_333_334, 66_666_666, 99_999_999])
    with pytest.raises(BadData, match=f"time stamp 3: .*, got {begin + 33_333_334} after {begin + 33_333_333}"):
        seconds(stamps, TIMES)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_times_that_are_not_finite_are_named(value: float) -> None:
    with pytest.raises(BadData, match=f"line 2: expected a finite time, got {value}.  fix: correct the line"):
        seconds(np.array([0.0, value, 1.0]), TIMES, [1, 2, 3])


def test_nanoseconds_declared_to_be_seconds_are_said_to_look_like_nanoseconds() -> None:
    stamps = NOVEMBER_2020 * 10**9 + np.arange(5) * 33_333_333
    with pytest.raises(
        BadData,
        match=r"line 2: expected at most an hour between frames, got \d+ after \d+: 3.33e\+07 s, read as seconds; "
        r"they look like nanoseconds since 1970.  fix: pass --time-unit ns\.",
    ):
        seconds(stamps, TIMES, range(1, 6), unit="s")
    assert seconds(stamps, TIMES, unit="ns").statement == "nanoseconds since 1970, from times.txt (--time-unit ns)"


def test_seconds_declared_to_be_nanoseconds_are_refused() -> None:
    with pytest.raises(
        BadData, match="expected a median interval of at least 1e-05 s, got .* they look like seconds since 1970"
    ):
        seconds(NOVEMBER_2020 + np.arange(5) / 30, TIMES, unit="ns")
    with pytest.raises(BadData, match="got 1e-06 s, read as seconds.  fix: pass --time-unit with the unit"):
        seconds(np.arange(5) * 1e-6, TIMES)


def test_a_pause_of_more_than_an_hour_is_refused_where_it_is() -> None:
    stamps = np.array([0.0, 0.1, 0.2, 4000.0, 4000.1])
    with pytest.raises(BadData, match="time stamp 4: expected at most an hour .* as two recordings"):
        seconds(stamps, TIMES)


def test_no_stamps_are_no_times() -> None:
    assert seconds(np.zeros(0), TIMES).time.shape == (0,)


@pytest.mark.parametrize(
    ("names", "time", "statement"),
    [
        (["frame-3", "frame-5"], [0.3, 0.5], "frame number / 10"),
        (["a", "b"], [0.0, 0.1], "place in the sorted list"),
        (["9", "7"], [0.0, 0.1], "place in the sorted list"),
        (["1700000000000000000", "1700000000033000000"], [0.0, 0.1], "place in the sorted list"),
    ],
)
def test_frames_are_counted_by_their_numbers_if_these_are_counts(
    names: list[str], time: list[float], statement: str
) -> None:
    clock = counted(names, 10.0)
    assert clock.time.tolist() == time and clock.statement.startswith(statement)
