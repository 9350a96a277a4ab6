"""Training with frames read and augmented on demand, against plain steps on one batch of tensors.

Frames are on disk and none is cached, the worst case: training caches those that fit in memory.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import torch

from bask_data.dataset import Dataset
from bask_data.kinds import Correspondences, Scan, VisibleMasks
from bask_data.nn.loss import contrastive
from bask_data.nn.network import DescriptorNetwork, NetworkSettings
from bask_data.nn.resnet import sampled
from bask_data.nn.sampling import Examples, SampleSettings, batch_of_step
from bask_data.nn.training import TrainingSettings, train_network
from bask_data.stages.pairs import Pairs, ScanPairs
from benchmarks.bench_sampling import AUGMENT, SAMPLE, SIZE, K, Scene
from tests.stages.learning import publish_learning

SETTINGS = TrainingSettings(steps=8, precision="float32")


def cases() -> Iterator[tuple[str, Callable[[], object], Callable[[], object]]]:
    with TemporaryDirectory(prefix="bask-data-bench-") as folder:
        source = on_disk(Scene(), Path(folder) / "d")
        for n_images in (2, 8):
            sample = replace(SAMPLE, n_pairs=n_images // 2)
            # The bar: ours takes at most 1.08 times as long, that is a ratio of 0.93 and more.
            yield (
                f"{SETTINGS.steps} steps, ResNet-18, 256x256, {n_images} images, against steps on a ready batch",
                lambda sample=sample: train_network(network(), Examples(source, sample, AUGMENT), SETTINGS),
                lambda sample=sample: ready_steps(source, sample),
            )


def on_disk(scene: Scene, root: Path) -> Pairs:
    """The same scene as a dataset, read as the stage reads it."""
    dataset = Dataset.create(root)
    matched = {(i, i + 1): scene.pair(i) for i in range(scene.n_pairs)}
    publish_learning(dataset, "a", K, scene.cameras, scene.views, matched)
    scan = ScanPairs(*(kind(dataset.path(kind, "a")) for kind in (Scan, VisibleMasks, Correspondences)))
    return Pairs([(scan, i) for i in range(len(scan.frames))])


def network() -> DescriptorNetwork:
    torch.manual_seed(0)
    made = DescriptorNetwork(NetworkSettings("resnet18", 16, SIZE[0]))
    made.channels_last()
    return made


def ready_steps(source: Pairs, sample: SampleSettings) -> None:
    """As many steps on a batch that is there already, and nothing else."""
    batch = batch_of_step(source, 0, 0, sample, AUGMENT).on(torch.device("cpu"))
    rgb = torch.cat([batch.rgb_a, batch.rgb_b])
    trained = network()
    trained.train()
    optimiser = torch.optim.Adam(trained.parameters(), lr=SETTINGS.learning_rate, weight_decay=SETTINGS.weight_decay)
    for _ in range(SETTINGS.steps):
        cells_a, cells_b = trained(rgb).chunk(2)
        others = sampled(cells_b, batch.non_matches_b.flatten(1, 2)).unflatten(1, batch.valid.shape[1:])
        matches_a, matches_b = sampled(cells_a, batch.uv_a), sampled(cells_b, batch.uv_b)
        loss = contrastive(matches_a, matches_b, others, batch.foreground, batch.valid).loss
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        optimiser.step()
