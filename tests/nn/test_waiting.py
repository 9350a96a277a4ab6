"""Spinning of torch's threads at barriers, as reported by its OpenMP runtime when loaded."""

from __future__ import annotations

import os
import re
import subprocess
import sys

import pytest

from bask_data.nn import CHOSEN_BY_USER, SPIN_COUNT


def settings_of(code: str, **environment: str) -> dict[str, str]:
    """The runtime's settings in a process that runs `code`."""
    unset = {name: value for name, value in os.environ.items() if name not in CHOSEN_BY_USER}
    process = subprocess.run(
        [sys.executable, "-c", code],
        env=unset | {"OMP_DISPLAY_ENV": "verbose"} | environment,
        capture_output=True,
        text=True,
        check=True,
    )
    settings = dict(re.findall(r"(GOMP_SPINCOUNT|OMP_WAIT_POLICY) = '(\w+)'", process.stderr))
    if not settings:
        pytest.skip("torch's OpenMP runtime here is not libgomp")
    return settings


def test_threads_of_training_spin_for_a_short_time_only() -> None:
    assert settings_of("import bask_data.nn.training")["GOMP_SPINCOUNT"] == str(SPIN_COUNT)


@pytest.mark.parametrize(("name", "value"), [("GOMP_SPINCOUNT", "77"), ("OMP_WAIT_POLICY", "ACTIVE")])
def test_a_setting_of_the_user_is_kept(name: str, value: str) -> None:
    assert settings_of("import bask_data.nn.training", **{name: value})[name] == value


def test_a_program_that_does_not_train_keeps_the_default() -> None:
    assert settings_of("import bask_data, torch")["GOMP_SPINCOUNT"] == "300000"


def test_threads_of_a_notebook_that_opens_a_loader_first_spin_for_a_short_time_only() -> None:
    assert settings_of("import bask_data.torch")["GOMP_SPINCOUNT"] == str(SPIN_COUNT)


@pytest.mark.parametrize(("code", "n_warnings"), [("import torch, bask_data.nn", 1), ("import bask_data.nn, torch", 0)])
def test_training_says_once_that_the_limit_came_too_late(code: str, n_warnings: int) -> None:
    unset = {name: value for name, value in os.environ.items() if name not in CHOSEN_BY_USER}
    warn = "bask_data.nn.warn_if_too_late()"
    done = subprocess.run(
        [sys.executable, "-W", "always", "-c", f"{code}; {warn}; {warn}"],
        env=unset,
        capture_output=True,
        text=True,
        check=True,
    )
    n_expected = n_warnings if sys.platform == "linux" else 0
    assert done.stderr.count("fix: import bask_data.nn before torch, or set GOMP_SPINCOUNT=1000.") == n_expected


def test_nothing_is_set_once_torch_is_loaded() -> None:
    code = "import os, torch, bask_data.nn; assert 'GOMP_SPINCOUNT' not in os.environ"
    assert settings_of(code)["GOMP_SPINCOUNT"] == "300000"
