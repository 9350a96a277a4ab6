"""Processes that train one network together, started by torchrun; or one alone."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from itertools import pairwise
from typing import TypeVar

import torch
from torch import Tensor, distributed, nn
from torch.nn.parallel import DistributedDataParallel

T = TypeVar("T")


class TooManyProcesses(Exception):
    """More processes than can have something to do."""

    def __init__(self, expected: str, got: str) -> None:
        super().__init__(f"expected {expected}, got {got}")
        self.expected, self.got = expected, got


@dataclass(frozen=True)
class Group:
    """This process among those that train together.

    Args:
        rank: the first, 0, validates, saves and says what there is to say.
    """

    rank: int = 0
    size: int = 1

    @property
    def is_first(self) -> bool:
        return self.rank == 0

    def share_of(self, n_examples: int, n_parts: int) -> list[range]:
        """This process's examples of a batch, in parts that are computed one after the other.

        Raises:
            TooManyProcesses: there are fewer examples.
        """
        if n_examples < self.size:
            raise TooManyProcesses(f"at most one for each of the batch's {n_examples} pairs", str(self.size))
        mine = _cut(range(n_examples), self.size)[self.rank]
        return _cut(mine, min(n_parts, len(mine)))

    def wrapped(self, network: nn.Module) -> nn.Module:
        """The network as it is called in training: its gradients are means over the processes."""
        if self.size == 1:
            return network
        # Of a kernel of one pixel, torch takes other strides for other layouts, and says so for each process.
        warnings.filterwarnings("ignore", "Grad strides do not match bucket view strides")
        return DistributedDataParallel(network, gradient_as_bucket_view=True)

    def sending(self, model: nn.Module, wanted: bool) -> AbstractContextManager[None]:
        """Whether the gradients of a backward pass in here are exchanged, or just added to this process's own."""
        return model.no_sync() if isinstance(model, DistributedDataParallel) and not wanted else nullcontext()

    def summed(self, values: Tensor) -> Tensor:
        """The sum of all processes' values."""
        if self.size > 1:
            distributed.all_reduce(values)
        return values

    def told(self, value: T) -> T:
        """The first process's value, in all."""
        if self.size == 1:
            return value
        box = [value]
        distributed.broadcast_object_list(box, src=0)
        return box[0]


ALONE = Group()


@contextmanager
def joined() -> Iterator[Group]:
    """The group that torchrun started this process in, while it lasts.

    Raises:
        TooManyProcesses: there are fewer GPUs, but some.
    """
    if torch.cuda.is_available():
        n_processes, n_gpus = int(os.environ["LOCAL_WORLD_SIZE"]), torch.cuda.device_count()
        if n_processes > n_gpus:
            raise TooManyProcesses(f"at most one for each of the {n_gpus} GPUs", str(n_processes))
        torch.cuda.set_device(int(os.environ["LOCAL_RANK"]))
    distributed.init_process_group("nccl" if torch.cuda.is_available() else "gloo")
    try:
        yield Group(distributed.get_rank(), distributed.get_world_size())
    finally:
        distributed.destroy_process_group()


def _cut(examples: range, n_parts: int) -> list[range]:
    """Neighbours together, in parts that differ by one at most."""
    ends = [len(examples) * i // n_parts for i in range(n_parts + 1)]
    return [examples[first:end] for first, end in pairwise(ends)]
