from __future__ import annotations

import threading
from collections.abc import Iterator

import pytest

from bask_data.errors import UsageError
from bask_data.picker.jobs import Cancelled, Jobs
from bask_data.progress import progress


class Clock:
    """A clock that the test advances, seconds."""

    now = 100.0

    def __call__(self) -> float:
        return self.now

    def steps(self, n: int, seconds: float) -> Iterator[int]:
        """A loop of n steps that take `seconds` each."""
        for i in progress(range(n), "looking"):
            yield i
            self.now += seconds


def test_a_job_reports_its_progress_and_remaining_time() -> None:
    clock = Clock()
    jobs = Jobs(clock)
    assert jobs.state() is None
    with jobs.running("propose", can_cancel=True):
        clock.now += 5.0  # Time before the loop counts as elapsed, not as a step's.
        seen = [jobs.state() for _ in clock.steps(4, seconds=2.0)]
    assert jobs.state() is None
    assert [state["done"] for state in seen] == [0, 1, 2, 3]
    assert [state["seconds"] for state in seen] == [5.0, 7.0, 9.0, 11.0]
    assert [state["seconds_left"] for state in seen] == [None, 6.0, 4.0, 2.0]
    assert {(state["name"], state["label"], state["total"]) for state in seen} == {("propose", "looking", 4)}


def test_a_loop_of_unknown_length_has_no_remaining_time() -> None:
    clock = Clock()
    jobs = Jobs(clock)
    with jobs.running("save", can_cancel=False):
        for _ in progress(iter([1, 2]), "writing"):
            clock.now += 1.0
        state = jobs.state()
    assert (state["done"], state["total"], state["seconds_left"]) == (2, None, None)


def test_a_cancelled_job_ends_at_its_next_step() -> None:
    jobs = Jobs()
    reached = []
    with pytest.raises(Cancelled), jobs.running("propose", can_cancel=True):  # noqa: PT012
        for i in progress(range(9), "looking"):
            reached.append(i)
            if i == 3:
                jobs.cancel()
                assert jobs.state()["is_cancelled"]
    assert reached == [0, 1, 2, 3]
    with jobs.running("propose", can_cancel=True):
        assert not jobs.state()["is_cancelled"]


def test_a_job_that_is_cancelled_after_its_last_step_is_cancelled() -> None:
    jobs = Jobs()
    with pytest.raises(Cancelled), jobs.running("propose", can_cancel=True):
        jobs.cancel()


def test_cancelling_has_no_effect_without_a_job_or_on_one_that_cannot_be_cancelled() -> None:
    jobs = Jobs()
    jobs.cancel()
    with jobs.running("save", can_cancel=False):
        jobs.cancel()
        assert list(progress(range(3), "writing")) == [0, 1, 2]


def test_two_jobs_at_once_are_refused_and_an_error_ends_the_first() -> None:
    jobs = Jobs()
    message = "save: expected no other job, got propose still running.  fix: wait for it, or cancel it."
    with jobs.running("propose", can_cancel=True), pytest.raises(UsageError, match=message):
        jobs.running("save", can_cancel=False).__enter__()
    with pytest.raises(KeyError), jobs.running("propose", can_cancel=True):
        raise KeyError
    assert jobs.state() is None


def test_waiting_ends_with_the_job() -> None:
    jobs, ended = Jobs(), []
    jobs.wait()
    with jobs.running("save", can_cancel=False):
        waiting = threading.Thread(target=lambda: (jobs.wait(), ended.append(jobs.state())))
        waiting.start()
        waiting.join(0.1)
        assert waiting.is_alive()
    waiting.join(30)
    assert ended == [None]
