"""Training beside other programs: how torch's threads wait for each other, ours against the runtime's default.

Each setting runs in a process of its own, because the OpenMP runtime reads it when it is loaded. The other programs
are two busy processes, paused during the idle runs. The cases:

- *idle* and *busy*: speed-up over the runtime's default without and with the two other processes.
  Targets: about 1, and far above.
- *slow-down*: how many times longer a step takes beside the two others than without them. Target: at most 2 for ours.

The idle figures are meaningful only if nothing else runs on the machine.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parent.parent
N_STEPS = 5
N_OTHERS = 2

RUNTIMES_DEFAULT = {"GOMP_SPINCOUNT": "300000"}
"""What libgomp does when nobody says otherwise: 3 ms by its own estimate."""


def cases() -> Iterator[tuple[str, Callable[[], object], Callable[[], object]]]:
    with ExitStack() as processes:
        ours = processes.enter_context(trainer({}))
        default = processes.enter_context(trainer(RUNTIMES_DEFAULT))
        others = processes.enter_context(busy_processes())
        beside = f"beside {N_OTHERS} busy processes"
        yield f"idle: {N_STEPS} steps, against the runtime's default", ours, default
        yield f"busy: {N_STEPS} steps {beside}, against the runtime's default", others(ours), others(default)
        yield f"slow-down {beside}: ours", ours, others(ours)
        yield f"slow-down {beside}: the runtime's default", default, others(default)


@contextmanager
def trainer(environment: dict[str, str]) -> Iterator[Callable[[], object]]:
    """A process that holds a network; the call lets it train for some steps."""
    clean = {name: value for name, value in os.environ.items() if name not in ("GOMP_SPINCOUNT", "OMP_WAIT_POLICY")}
    paths = {"PYTHONPATH": os.pathsep.join([str(REPOSITORY), os.environ.get("PYTHONPATH", "")])}
    process = subprocess.Popen(
        [sys.executable, __file__],
        env=clean | paths | environment,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdin is not None
    assert process.stdout is not None

    def steps() -> None:
        print(N_STEPS, file=process.stdin, flush=True)
        if process.stdout.readline() != "done\n":
            raise RuntimeError("the training process has ended")

    try:
        yield steps
    finally:
        process.stdin.close()
        process.wait()


@contextmanager
def busy_processes() -> Iterator[Callable[[Callable[[], object]], Callable[[], object]]]:
    """Processes that never rest while a call that is wrapped lasts, and are stopped otherwise."""
    running = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(N_OTHERS)]

    def tell(what: signal.Signals) -> None:
        for process in running:
            process.send_signal(what)

    def disturbed(work: Callable[[], object]) -> Callable[[], object]:
        def call() -> None:
            tell(signal.SIGCONT)
            try:
                work()
            finally:
                tell(signal.SIGSTOP)

        return call

    tell(signal.SIGSTOP)
    try:
        yield disturbed
    finally:
        for process in running:
            process.kill()
            process.wait()


def serve() -> None:
    """Train the default network for as many steps as each line of the input says."""
    # Ours comes first: it is the import of bask_data.nn that says how torch's threads wait.
    from bask_data.nn.augment import AugmentSettings
    from bask_data.nn.network import NetworkSettings, create
    from bask_data.nn.sampling import Examples, SampleSettings
    from bask_data.nn.training import TrainingSettings, train_network
    from benchmarks.bench_sampling import Scene

    scene = Scene()
    network = create(NetworkSettings("efficientnet-lite0-tuned", 32, 256), seed=0)
    network.channels_last()
    sample = SampleSettings((128, 128), n_pairs=2, n_matches=128, n_non_matches=0)
    examples = Examples(scene, sample, AugmentSettings())
    for line in sys.stdin:
        settings = TrainingSettings(steps=int(line), loss="infonce", frozen_batch_norm=True)
        train_network(network, examples, settings)
        print("done", flush=True)


if __name__ == "__main__":
    serve()
