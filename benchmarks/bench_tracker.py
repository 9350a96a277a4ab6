"""Steps of the online tracker, one camera of 256x256, 16 keypoints, against the plain forward pass of its network.

The default network of `bask-data train`, and a ResNet-18, with the options that `docs/runtime.md` compares. The two
sides do not do the same work: a step is the network, the distance maps and the filter, in successive frames of which,
with `every`, most do without the network. The last case of each network, folded against plain, is the same work.

Steps a second, with two threads on two idle cores: `OMP_NUM_THREADS=2 python benchmarks/bench_tracker.py`, of one
network `... bench_tracker.py "ResNet-18"`.
"""

from __future__ import annotations

import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np

from bask_data.kinds import Pick, ReferenceKeypoints
from bask_data.nn.folding import folded
from bask_data.nn.network import DescriptorNetwork, NetworkSettings, create
from bask_data.tracker import KeypointTracker

SIZE, N_KEYPOINTS, N_FRAMES = 256, 16, 6
NETWORKS = {"the default network": ("efficientnet-lite0-tuned", 32), "ResNet-18": ("resnet18", 64)}
LARGE = {"ResNet-101": ("resnet101", 64)}
OPTIONS: dict[str, dict[str, float]] = {
    "as it is": {},
    "every=2": {"every": 2},
    "every=3": {"every": 3},
    "scale=0.75": {"scale": 0.75},
    "scale=0.5": {"scale": 0.5},
    "scale=0.5, every=2": {"scale": 0.5, "every": 2},
}


def cases() -> Iterator[tuple[str, Callable[[], object], Callable[[], object]]]:
    with tempfile.TemporaryDirectory() as folder:
        for name in NETWORKS:
            network, images = _network(name), _images()
            for option, given in OPTIONS.items():
                steps = _steps(network, Path(folder) / f"{name}{option}", images, given)
                yield f"{N_FRAMES} steps, {name}, {option}", steps, partial(_forward, network, images)
            ready = folded(network)
            yield f"{name}, folded against plain", partial(_forward, ready, images), partial(_forward, network, images)


def _network(name: str) -> DescriptorNetwork:
    """Untrained: only its time matters."""
    backbone, dimension = (NETWORKS | LARGE)[name]
    network = create(NetworkSettings(backbone, dimension, SIZE), seed=0).eval()
    network.channels_last()
    return network


def _forward(network: DescriptorNetwork, images: np.ndarray) -> None:
    """Frame by frame, as a robot sees them."""
    for image in images:
        network.cells(image)


def _images() -> np.ndarray:
    """A wall of random squares, from a camera that moves along it (t, h, w, 3)."""
    squares = np.random.default_rng(0).integers(0, 256, (SIZE // 16, SIZE // 8, 3), dtype=np.uint8)
    wall = squares.repeat(16, axis=0).repeat(16, axis=1)
    return np.stack([wall[:, 4 * i : 4 * i + SIZE] for i in range(N_FRAMES)])


def _steps(
    network: DescriptorNetwork, folder: Path, images: np.ndarray, options: dict[str, float]
) -> Callable[[], object]:
    """All frames by one tracker, which begins anew in each round."""
    uv = np.random.default_rng(0).uniform(40, SIZE - 40, (N_KEYPOINTS, 2)).astype(np.float32)
    picks = [Pick(name=f"k{i}", recording="a", camera="wrist", frame=0, u=0, v=0) for i in range(N_KEYPOINTS)]
    ReferenceKeypoints.write(folder, descriptors=network.descriptors_at(images[0], uv).numpy(), picks=picks)
    tracker = KeypointTracker(folded(network), ReferenceKeypoints(folder), device="cpu", **options)
    K = {"wrist": np.array([[1000.0, 0, 127.5], [0, 1000.0, 127.5], [0, 0, 1]])}
    depth = {"wrist": np.ones((SIZE, SIZE), np.float32)}
    poses = np.tile(np.eye(4), (N_FRAMES, 1, 1))
    poses[:, 0, 3] = 0.004 * np.arange(N_FRAMES)

    def steps() -> None:
        tracker.reset()
        for image, pose in zip(images, poses, strict=True):
            tracker.step({"wrist": image}, depth, K, {"wrist": pose}, np.eye(4))

    return steps


def main() -> None:
    """Print steps a second, and CPU time, which on a single thread depends little on other programs."""
    networks = sys.argv[1:] or [*NETWORKS, *LARGE]
    with tempfile.TemporaryDirectory() as folder:
        for name in networks:
            network, images = _network(name), _images()
            for option, given in OPTIONS.items():
                steps = _steps(network, Path(folder) / f"{name}{option}", images, given)
                steps()
                rounds, cpu = [], []
                for _ in range(5 if name in NETWORKS else 2):
                    begun, cpu_begun = time.perf_counter(), time.process_time()
                    steps()
                    rounds.append(time.perf_counter() - begun)
                    cpu.append(time.process_time() - cpu_begun)
                a_second, each = N_FRAMES / statistics.median(rounds), statistics.median(cpu) / N_FRAMES
                print(f"{name}, {option}: {a_second:.1f} steps a second, {1000 * each:.0f} ms of CPU time", flush=True)


if __name__ == "__main__":
    main()
