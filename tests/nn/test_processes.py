from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from bask_data.nn.processes import ALONE, Group, TooManyProcesses, joined


@given(st.integers(1, 40), st.integers(1, 8), st.integers(1, 6))
def test_processes_and_parts_cover_a_batch_exactly_once(n_examples, size, n_parts):
    if n_examples < size:
        return
    shares = [Group(rank, size).share_of(n_examples, n_parts) for rank in range(size)]
    assert [i for parts in shares for part in parts for i in part] == list(range(n_examples))
    counts = [sum(map(len, parts)) for parts in shares]
    assert max(counts) - min(counts) <= 1
    for parts, count in zip(shares, counts, strict=True):
        assert len(parts) == min(n_parts, count)
        assert max(map(len, parts)) - min(map(len, parts)) <= 1


def test_fewer_pairs_than_processes_are_refused():
    with pytest.raises(TooManyProcesses, match="expected at most one for each of the batch's 2 pairs, got 3"):
        Group(0, 3).share_of(2, 1)


def test_a_single_process_changes_nothing():
    network = torch.nn.Linear(2, 2)
    assert ALONE.wrapped(network) is network
    assert ALONE.broadcast("x") == "x"
    assert ALONE.summed(torch.tensor([3.0])).tolist() == [3.0]
    assert ALONE.is_first
    assert not Group(1, 2).is_first


def test_more_processes_than_gpus_are_refused(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "3")
    with pytest.raises(TooManyProcesses, match="expected at most one for each of the 2 GPUs, got 3"), joined():
        pass
