"""Networks, losses and training loops: everything that needs torch.

On a CPU, torch's threads wait for each other at the end of every parallel loop, some thousand times a training step.
The OpenMP runtime of its Linux wheels, libgomp, lets them wait actively for 3 ms before they sleep. Where other
programs want the processors, too, the thread that is waited for often does not run meanwhile: a step of 0.2 s takes
3 to 8 s. Here they wait `SPIN_COUNT` turns, unless the environment says how long. The runtime reads the environment
when torch is first imported, and every import of a module of this package comes through here before that.
"""

from __future__ import annotations

import os
import sys

SPIN_COUNT = 1000
"""Turns of active waiting, each a pause instruction: some 50 us on current Intel processors, about what it costs to put
a thread to sleep and wake it, and far less than a scheduler's time slice of 3 ms.

Measured with `benchmarks/bench_busy.py` on two cores, the default network, two other processes that never rest: 0, 300
and 1000 turns slow a step 1.6 to 1.8 times, which is hardly more than the fair share of the processors (2 threads of
4) asks for; 3000 turns 2.7 times, 10 000 3.8 times, libgomp's 300 000 up to 15 times. With free cores all of them take
the same time within what it wavers, 10 %.
"""

CHOSEN_BY_USER = ("GOMP_SPINCOUNT", "OMP_WAIT_POLICY")
"""Variables that say how libgomp waits; where one is set, nothing is changed."""

if "torch" not in sys.modules and not any(name in os.environ for name in CHOSEN_BY_USER):
    os.environ["GOMP_SPINCOUNT"] = str(SPIN_COUNT)
