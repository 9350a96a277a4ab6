"""How torch's threads wait for each other, as its OpenMP runtime itself says when it is loaded."""

from __future__ import annotations

import os
import re
import subprocess
import sys

import pytest

from bask_data.nn import CHOSEN_BY_USER, SPIN_COUNT


def told(code: str, **environment: str) -> dict[str, str]:
    """The runtime's settings in a process that runs `code`."""
    clean = {name: value for name, value in os.environ.items() if name not in CHOSEN_BY_USER}
    answer = subprocess.run(
        [sys.executable, "-c", code],
        env=clean | {"OMP_DISPLAY_ENV": "verbose"} | environment,
        capture_output=True,
        text=True,
        check=True,
    )
    found = dict(re.findall(r"(GOMP_SPINCOUNT|OMP_WAIT_POLICY) = '(\w+)'", answer.stderr))
    if not found:
        pytest.skip("torch's OpenMP runtime here is not libgomp")
    return found


def test_threads_of_training_wait_actively_for_a_short_time_only() -> None:
    assert told("import bask_data.nn.training")["GOMP_SPINCOUNT"] == str(SPIN_COUNT)


@pytest.mark.parametrize(("name", "value"), [("GOMP_SPINCOUNT", "77"), ("OMP_WAIT_POLICY", "ACTIVE")])
def test_what_the_user_says_of_waiting_stands(name: str, value: str) -> None:
    assert told("import bask_data.nn.training", **{name: value})[name] == value


def test_a_program_that_trains_nothing_is_left_alone() -> None:
    assert told("import bask_data, torch")["GOMP_SPINCOUNT"] == "300000"


def test_an_environment_that_comes_too_late_is_left_alone() -> None:
    code = "import os, torch, bask_data.nn; assert 'GOMP_SPINCOUNT' not in os.environ"
    assert told(code)["GOMP_SPINCOUNT"] == "300000"
