from __future__ import annotations

import threading
from collections.abc import Iterator

import pytest

from bask_data.progress import Pace, Steps, listen, listened_by, progress


@pytest.fixture
def heard() -> Iterator[list[tuple[str, int, int | None]]]:
    """What the process's listener is called with."""
    calls: list[tuple[str, int, int | None]] = []
    listen(lambda *call: calls.append(call))
    yield calls
    listen(None)


def test_several_loops_count_as_steps_of_one(heard) -> None:
    steps = Steps("looking", 6)
    assert list(steps.over("ab")) == ["a", "b"]
    assert list(steps.over("c", weight=3)) == ["c"]
    steps.reach(9)
    assert heard == [("looking", done, 6) for done in (0, 1, 2, 5, 6)]


def test_thread_listener_hears_only_its_thread_and_the_process_listener_all(heard) -> None:
    own: list[str] = []
    other = threading.Thread(target=lambda: list(progress([1], "other")))
    with listened_by(lambda label, done, total: own.append(f"{label} {done}/{total}")):
        other.start()
        other.join()
        list(progress([1, 2], "own"))
    list(progress([1], "later"))
    assert own == ["own 0/2", "own 1/2", "own 2/2"]
    assert [label for label, done, _ in heard if done == 0] == ["other", "own", "later"]


def test_a_listener_that_raises_ends_the_loop_at_that_step() -> None:
    def stop(label: str, done: int, total: int | None) -> None:
        if done == 2:
            raise KeyError(label)

    reached: list[int] = []
    with pytest.raises(KeyError, match="counting"), listened_by(stop):
        reached.extend(progress([1, 2, 3], "counting"))
    assert reached == [1, 2]


def test_the_time_left_does_not_count_a_slow_first_step(monkeypatch: pytest.MonkeyPatch) -> None:
    now, pace = 0.0, Pace()
    monkeypatch.setattr("bask_data.progress.time.monotonic", lambda: now)

    def left_at(seconds: float, done: int, label: str = "training") -> float | None:
        nonlocal now
        now = seconds
        return pace.seconds_left(label, done, 100)

    assert [left_at(at, done) for at, done in ((0, 0), (20, 1), (20.5, 2), (21, 3))] == [None] * 4
    assert left_at(21.5, 4) == pytest.approx(96 * 0.5)
    assert left_at(24, 9) == pytest.approx(91 * 0.5)
    assert [left_at(at, done, "other") for at, done in ((30, 0), (40, 1))] == [None, None]
    assert left_at(43, 4, "other") == pytest.approx(96)
    # Steps done before, which a resumed loop reports at once, do not count either.
    assert [left_at(at, done) for at, done in ((50, 0), (51, 80), (57, 83))] == [None, None, pytest.approx(17 * 2)]
    assert pace.seconds_left("unknown", 5, None) is None
