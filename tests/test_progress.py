from __future__ import annotations

import threading
from collections.abc import Iterator

import pytest

from bask_data.progress import Steps, listen, listened_by, progress


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
