"""The command as a user starts it: killed and started again, or in several processes at once."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load_file

from bask_data.artifact import read_manifest
from bask_data.dataset import Dataset
from bask_data.kinds import DescriptorNet
from bask_data.validate import validate
from tests.stages.learning import SMALL, learning_dataset

COMMAND = ["-m", "bask_data.cli", "train"]
TORCHRUN = ["-m", "torch.distributed.run", "--nproc-per-node", "2"]
PARAMETERS = {
    **SMALL,
    "steps": 4,
    "validations": 4,
    "pairs_per_step": 2,
    "loss": "contrastive",
    "non_matches": 20,
    "frozen_batch_norm": True,
}


def options(**changed: object) -> list[str]:
    given = {name.replace("_", "-"): value for name, value in {**PARAMETERS, **changed}.items()}
    return [
        part
        for name, value in given.items()
        for part in ([f"--{name}"] if value is True else [f"--{name}", as_option(value)])
    ]


def as_option(value: object) -> str:
    return ",".join(map(str, value)) if isinstance(value, tuple) else str(value)


def python(*arguments: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, *map(str, arguments)], capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def untrained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return learning_dataset(tmp_path_factory.mktemp("command") / "d", n_views=4).root


@pytest.fixture(scope="module")
def trained(untrained: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Trained by one process without interruption."""
    root = shutil.copytree(untrained, tmp_path_factory.mktemp("trained") / "d")
    ended = python(*COMMAND, root, *options())
    assert ended.returncode == 0, ended.stderr
    return root


def descriptor(root: Path) -> DescriptorNet:
    return DescriptorNet(root / "descriptor" / "main")


@pytest.mark.kill
@pytest.mark.parametrize("step", [pytest.param(1, marks=pytest.mark.slow), 2, pytest.param(3, marks=pytest.mark.slow)])
def test_killed_it_goes_on_where_it_was_and_ends_with_the_same_bytes(untrained, trained, tmp_path, step):
    root = shutil.copytree(untrained, tmp_path / "d")
    with subprocess.Popen(
        [sys.executable, *COMMAND, root, *options()], stderr=subprocess.PIPE, text=True, start_new_session=True
    ) as process:
        assert process.stderr is not None
        for line in process.stderr:
            if f"step {step}/4" in line:
                os.killpg(process.pid, signal.SIGKILL)
    assert process.returncode == -signal.SIGKILL
    assert not descriptor(root).path.exists()
    again = python(*COMMAND, root, *options())
    assert again.returncode == 0, again.stderr
    # It may have been killed before its first state was whole.
    assert step == 1 or "step 1/4" not in again.stderr
    assert "step 4/4" in again.stderr
    assert read_manifest(descriptor(root).path).digest == read_manifest(descriptor(trained).path).digest
    assert not [entry for entry in (root / ".scratch").iterdir() if entry.is_dir()]


def test_two_processes_learn_what_one_does_with_the_whole_batch(untrained, trained, tmp_path):
    root = shutil.copytree(untrained, tmp_path / "d")
    ended = python(*TORCHRUN, *COMMAND, root, *options(), "--json")
    assert ended.returncode == 0, ended.stderr
    # One of them publishes and speaks.
    assert [outcome["status"] for outcome in json.loads(ended.stdout)["outcomes"]] == ["made"]
    assert ended.stderr.count("step 4/4") == 1
    assert "Warning" not in ended.stderr
    assert validate(Dataset(root)) == []
    of_two, of_one = descriptor(root), descriptor(trained)
    rows, expected = of_two.curve().to_pylist(), of_one.curve().to_pylist()
    assert [(row["step"], row["name"]) for row in rows] == [(row["step"], row["name"]) for row in expected]
    losses = [[row["value"] for row in table if row["name"].startswith("loss")] for table in (rows, expected)]
    assert max(losses[1]) > 0.01
    np.testing.assert_allclose(*losses, rtol=1e-3)
    # The first step's loss is of the same weights.
    np.testing.assert_allclose(losses[0][0], losses[1][0], rtol=1e-6)
    for name, value in load_file(of_one.path / "weights.safetensors").items():
        np.testing.assert_allclose(load_file(of_two.path / "weights.safetensors")[name], value, atol=2e-3, err_msg=name)
    assert json.loads((root / "runs/descriptor/main/run.json").read_text())["processes"] == 2


@pytest.mark.slow
def test_two_processes_agree_that_there_is_nothing_to_do(trained):
    ended = python(*TORCHRUN, *COMMAND, trained, *options())
    assert ended.returncode == 0, ended.stderr
    assert ended.stderr.count("up to date") == 1


def test_other_commands_are_not_for_several_processes(untrained, monkeypatch):
    for name, value in (("TORCHELASTIC_RUN_ID", "none"), ("WORLD_SIZE", "2"), ("RANK", "1")):
        monkeypatch.setenv(name, value)
    ended = python("-m", "bask_data.cli", "info", untrained)
    assert ended.returncode == 2
    assert "torchrun: command: expected train, got info" in ended.stderr
