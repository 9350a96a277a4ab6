from __future__ import annotations

from pathlib import Path

import pytest
import torch

from bask_data.nn.state import (
    BEST,
    STATE,
    Progress,
    copied,
    load_state,
    remove_all_but_state,
    remove_damaged_state,
    remove_state,
    save_state,
    saved_step,
)

CURVE = [(1, "loss", 0.1), (2, "loss", 1 / 3)]


def trained() -> tuple[torch.nn.Module, torch.optim.Optimizer]:
    """A network and an optimiser with moments, laid out as in training."""
    torch.manual_seed(0)
    network = torch.nn.Sequential(torch.nn.Conv2d(3, 4, 3), torch.nn.BatchNorm2d(4)).to(
        memory_format=torch.channels_last
    )
    optimiser = torch.optim.Adam(network.parameters())
    for _ in range(2):
        network(torch.rand(2, 3, 8, 8)).square().sum().backward()
        optimiser.step()
    return network, optimiser


def untrained() -> tuple[torch.nn.Module, torch.optim.Optimizer]:
    network = torch.nn.Sequential(torch.nn.Conv2d(3, 4, 3), torch.nn.BatchNorm2d(4)).to(
        memory_format=torch.channels_last
    )
    return network, torch.optim.Adam(network.parameters())


def names(folder: Path) -> list[str]:
    return sorted(file.name for file in folder.iterdir())


def test_a_loaded_state_is_bit_identical_and_has_the_networks_memory_layout(tmp_path):
    network, optimiser = trained()
    best = {name: value + 1 for name, value in copied(network).items()}
    save_state(tmp_path, network, optimiser, Progress(2, CURVE, 1, best))
    assert saved_step(tmp_path) == 2
    other, of_other = untrained()
    found = load_state(tmp_path, other, of_other)
    assert (found.step, found.curve, found.best_step) == (2, CURVE, 1)
    assert found.best.keys() == best.keys()
    assert all(torch.equal(found.best[name], value) for name, value in best.items())
    assert all(torch.equal(value, other.state_dict()[name]) for name, value in network.state_dict().items())
    expected, states = optimiser.state_dict()["state"], of_other.state_dict()["state"]
    for i, state in expected.items():
        assert state.keys() == states[i].keys() == {"step", "exp_avg", "exp_avg_sq"}
        assert all(torch.equal(value, states[i][name]) for name, value in state.items())
    assert states[0]["exp_avg"].is_contiguous(memory_format=torch.channels_last)


def test_without_a_state_training_starts_at_step_zero(tmp_path):
    network, optimiser = untrained()
    before = copied(network)
    assert load_state(tmp_path, network, optimiser) == Progress()
    assert saved_step(tmp_path) == 0
    assert all(torch.equal(value, before[name]) for name, value in network.state_dict().items())


def test_a_kill_between_writing_best_weights_and_state_leaves_a_consistent_pair(tmp_path, monkeypatch):
    from bask_data.nn import state

    network, optimiser = trained()
    first = copied(network)
    save_state(tmp_path, network, optimiser, Progress(1, CURVE, 1, first))
    write = state._write

    def killed(file: Path, *given: object) -> None:
        if file.name == STATE:
            raise KeyboardInterrupt
        write(file, *given)

    monkeypatch.setattr(state, "_write", killed)
    better = {name: value + 1 for name, value in first.items()}
    with pytest.raises(KeyboardInterrupt):
        save_state(tmp_path, network, optimiser, Progress(2, CURVE, 2, better))
    found = load_state(tmp_path, *untrained())
    assert (found.step, found.best_step) == (1, 1)
    assert all(torch.equal(value, first[name]) for name, value in found.best.items())


def test_only_the_best_weights_of_the_state_are_kept(tmp_path):
    network, optimiser = trained()
    for step in (1, 2, 3):
        save_state(tmp_path, network, optimiser, Progress(step, CURVE, min(step, 2), copied(network)))
    assert names(tmp_path) == [BEST.format(step=2), STATE]


@pytest.mark.parametrize("truncated", [STATE, BEST.format(step=1)])
@pytest.mark.parametrize("left", [0, 5, 200])
def test_a_truncated_state_is_deleted_and_an_intact_one_is_not(tmp_path, truncated, left):
    network, optimiser = trained()
    save_state(tmp_path, network, optimiser, Progress(2, CURVE, 1, copied(network)))
    assert not remove_damaged_state(tmp_path)
    assert saved_step(tmp_path) == 2
    (tmp_path / truncated).write_bytes((tmp_path / truncated).read_bytes()[:left])
    assert remove_damaged_state(tmp_path)
    assert names(tmp_path) == []
    assert not remove_damaged_state(tmp_path)


def test_a_state_without_its_best_weights_is_deleted(tmp_path):
    network, optimiser = trained()
    save_state(tmp_path, network, optimiser, Progress(2, CURVE, 1, copied(network)))
    (tmp_path / BEST.format(step=1)).unlink()
    assert remove_damaged_state(tmp_path)
    assert names(tmp_path) == []


def test_half_written_files_are_deleted_and_the_state_at_the_end(tmp_path):
    network, optimiser = trained()
    save_state(tmp_path, network, optimiser, Progress(2, CURVE, 1, copied(network)))
    for left in ("state.part", ".tmpqWgRll", "best~3.part"):
        (tmp_path / left).touch()
    (tmp_path / "folder").mkdir()
    remove_all_but_state(tmp_path)
    assert names(tmp_path) == [BEST.format(step=1), STATE]
    remove_state(tmp_path)
    assert names(tmp_path) == []
