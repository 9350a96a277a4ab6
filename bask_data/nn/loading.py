"""Prefetching of batches in threads, so that training does not wait for them."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import TypeVar

import torch

T = TypeVar("T")

PREFETCHED = 3
"""Batches prefetched per thread: enough to bridge a slow one, few enough for memory. Does not affect results."""


@dataclass
class Waited:
    """Total time spent waiting for batches, seconds."""

    seconds: float = 0.0


def ahead(
    make: Callable[[int], T], steps: Iterator[int], n_steps: int, waited: Waited
) -> Generator[tuple[int, T], None, None]:
    """Each step and `make(step)`, in order, computed ahead by threads: OpenCV, NumPy and Zarr release Python's lock.

    Close the generator if it is not exhausted, or its threads run until it is garbage-collected.

    Args:
        make: thread-safe; its errors are raised when the step is reached.
        steps: consecutive numbers of steps.
        n_steps: no step from this number on is prefetched.
        waited: the time spent waiting for each step is added to it.
    """
    n_threads = 1 if torch.get_num_threads() < 4 and not torch.cuda.is_available() else 4
    pending: dict[int, Future[T]] = {}
    with ThreadPoolExecutor(n_threads, thread_name_prefix="batches") as pool:
        try:
            for step in steps:
                for next_step in range(step, min(step + PREFETCHED * n_threads, n_steps)):
                    if next_step not in pending:
                        pending[next_step] = pool.submit(make, next_step)
                begun = time.perf_counter()
                batch = pending.pop(step).result()
                waited.seconds += time.perf_counter() - begun
                yield step, batch
        finally:
            pool.shutdown(wait=True, cancel_futures=True)
