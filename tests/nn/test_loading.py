from __future__ import annotations

import threading
import time

import pytest

from bask_data.nn.loading import PREFETCHED, Waited, ahead


def test_batches_come_in_order_and_are_made_once_each():
    made: list[int] = []

    def make(step: int) -> str:
        made.append(step)
        return f"batch {step}"

    found = list(ahead(make, iter(range(3, 9)), 9, Waited()))
    assert found == [(step, f"batch {step}") for step in range(3, 9)]
    assert made == list(range(3, 9))


def test_a_limited_number_of_batches_is_made_while_one_is_used():
    made: list[int] = []
    enough = threading.Event()

    def make(step: int) -> int:
        made.append(step)
        if len(made) == PREFETCHED:
            enough.set()
        return step

    batches = ahead(make, iter(range(100)), 100, Waited())
    next(batches)
    assert enough.wait(10), "while the first is in use, the next ones are made"
    time.sleep(0.05)
    assert len(made) == PREFETCHED
    batches.close()
    assert len(made) == PREFETCHED


def test_the_time_spent_waiting_is_measured():
    release = threading.Event()

    def make(step: int) -> int:
        if step == 1:
            release.wait(10)
        return step

    waited = Waited()
    batches = ahead(make, iter(range(2)), 2, waited)
    next(batches)
    before = waited.seconds
    threading.Timer(0.3, release.set).start()
    next(batches)
    assert 0.2 < waited.seconds - before < 5


def test_a_consumer_slower_than_the_batches_does_not_wait():
    waited = Waited()
    for step, _ in ahead(lambda step: step, iter(range(6)), 6, waited):
        if step == 0:
            first = waited.seconds
        time.sleep(0.05)
    assert waited.seconds - first < 0.02


def test_an_error_in_making_a_batch_reaches_the_consumer():
    def make(step: int) -> int:
        raise ValueError(f"no batch {step}")

    with pytest.raises(ValueError, match="no batch 0"):
        next(ahead(make, iter(range(2)), 2, Waited()))
