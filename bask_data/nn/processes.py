"""Groups of processes, started by torchrun, that train one network; a single process is a group, too."""

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
    """More processes than pairs in a batch or than GPUs."""

    def __init__(self, expected: str, got: str) -> None:
        super().__init__(f"expected {expected}, got {got}")
        self.expected, self.got = expected, got


@dataclass(frozen=True)
class Group:
    """This process's place in its group.

    Args:
        rank: process 0 validates, saves and reports.
        size: number of processes.
    """

    rank: int = 0
    size: int = 1

    @property
    def is_first(self) -> bool:
        return self.rank == 0

    def share_of(self, n_examples: int, n_parts: int) -> list[range]:
        """This process's examples of a batch, in parts to be computed in sequence.

        Raises:
            TooManyProcesses: there are more processes than examples.
        """
        if n_examples < self.size:
            raise TooManyProcesses(f"at most one for each of the batch's {n_examples} pairs", str(self.size))
        own = _cut(range(n_examples), self.size)[self.rank]
        return _cut(own, min(n_parts, len(own)))

    def wrapped(self, network: nn.Module) -> nn.Module:
        """The network to call in training: its gradients are averaged over the processes."""
        if self.size == 1:
            return network
        # The strides of 1x1 kernels are ambiguous between layouts, and torch warns about it in every process.
        warnings.filterwarnings("ignore", "Grad strides do not match bucket view strides")
        return DistributedDataParallel(network, gradient_as_bucket_view=True)

    def exchanging(self, model: nn.Module, exchanged: bool) -> AbstractContextManager[None]:
        """A context for backward passes: gradients are exchanged, or only accumulated in this process."""
        return model.no_sync() if isinstance(model, DistributedDataParallel) and not exchanged else nullcontext()

    def summed(self, values: Tensor) -> Tensor:
        """The sum of `values` over the processes, in place."""
        if self.size > 1:
            distributed.all_reduce(values)
        return values

    def broadcast(self, value: T) -> T:
        """The first process's value, in every process."""
        if self.size == 1:
            return value
        box = [value]
        distributed.broadcast_object_list(box, src=0)
        return box[0]


ALONE = Group()


@contextmanager
def joined() -> Iterator[Group]:
    """A context with the group that torchrun started this process in.

    Raises:
        TooManyProcesses: there are GPUs, but fewer than processes.
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
    """Consecutive parts whose lengths differ by at most one."""
    ends = [len(examples) * i // n_parts for i in range(n_parts + 1)]
    return [examples[first:end] for first, end in pairwise(ends)]
