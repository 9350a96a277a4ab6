"""Batches made ahead of their use, so that training does not wait for them."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import TypeVar

import torch

T = TypeVar("T")

PREFETCHED = 3
"""Batches made ahead by each thread: enough to bridge a slow one, few enough to cost no memory. Changes no result."""


@dataclass
class Waited:
    """Seconds spent waiting for batches so far."""

    seconds: float = 0.0


def ahead(
    make: Callable[[int], T], steps: Iterator[int], n_steps: int, waited: Waited
) -> Generator[tuple[int, T], None, None]:
    """What `make` gives for each step, in order, made by threads: OpenCV, NumPy and zarr let go of Python's lock.

    Close it when it is not used to its end: its threads would else run on until the garbage collector comes by.

    Args:
        steps: numbers of steps, one after the other; none is made from `n_steps` on.
        waited: told how long each one was waited for.
    """
    threads = 1 if torch.get_num_threads() < 4 and not torch.cuda.is_available() else 4
    waiting: dict[int, Future[T]] = {}
    with ThreadPoolExecutor(threads, thread_name_prefix="batches") as pool:
        try:
            for step in steps:
                for next_step in range(step, min(step + PREFETCHED * threads, n_steps)):
                    if next_step not in waiting:
                        waiting[next_step] = pool.submit(make, next_step)
                begun = time.perf_counter()
                made = waiting.pop(step).result()
                waited.seconds += time.perf_counter() - begun
                yield step, made
        finally:
            pool.shutdown(wait=True, cancel_futures=True)
