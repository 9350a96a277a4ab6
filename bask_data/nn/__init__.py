"""Networks, losses and training loops: everything that needs torch.

On a CPU, torch's threads meet at a barrier after every parallel loop, about a thousand times per training step. By
default libgomp, the OpenMP runtime of torch's Linux wheels, lets them spin at a barrier for 3 ms before they sleep. On
a busy machine the thread they wait for is often not running, and a step takes several times as long. This package
limits spinning to `SPIN_COUNT` iterations, unless the environment already sets a limit. The runtime reads the
environment when torch is first imported; importing any module of this package runs the code below before that.
"""

from __future__ import annotations

import os
import sys
import warnings
from functools import cache

SPIN_COUNT = 1000
"""Iterations of a spin at a barrier before a thread sleeps, each one pause instruction.

Chosen among 300 to 10 000 on a shared machine with two cores; `benchmarks/bench_busy.py` measures it.
"""

CHOSEN_BY_USER = ("GOMP_SPINCOUNT", "OMP_WAIT_POLICY")
"""Environment variables that control spinning in libgomp; if one of them is set, nothing is changed."""

IS_TOO_LATE = "torch" in sys.modules and not any(name in os.environ for name in CHOSEN_BY_USER)
"""Whether torch was loaded first, with its runtime's default, as by a notebook that imports both."""

if "torch" not in sys.modules and not any(name in os.environ for name in CHOSEN_BY_USER):
    os.environ["GOMP_SPINCOUNT"] = str(SPIN_COUNT)


@cache
def warn_if_too_late() -> None:
    """Warn once, where libgomp is torch's runtime, that training will be slow on a busy machine."""
    if IS_TOO_LATE and sys.platform == "linux":
        text = (
            "torch was loaded before bask_data.nn could limit how long its threads spin, so training is slow on a busy "
            f"machine.  fix: import bask_data.nn before torch, or set GOMP_SPINCOUNT={SPIN_COUNT}."
        )
        warnings.warn(text, RuntimeWarning, stacklevel=2)
