"""A small dataset with frames to pick in, and an untrained network."""

from __future__ import annotations

from pathlib import Path

import torch

from bask_data.dataset import Dataset
from bask_data.kinds import Demonstration, DescriptorNet, Recording, Scan
from bask_data.nn.network import DescriptorNetwork, NetworkSettings
from bask_data.picker.gallery import FrameName
from tests.datasets import publish_artifact
from tests.nn import pairs
from tests.stages.learning import learning_dataset, publish_views

N_VIEWS = 4
HEIGHT, WIDTH = pairs.SIZE


def untrained() -> DescriptorNetwork:
    torch.manual_seed(0)
    return DescriptorNetwork(NetworkSettings("resnet18", descriptor_dim=8, height=48)).eval()


def pickable_dataset(root: Path) -> Dataset:
    """Scans `a` and `b` with masks, a demonstration `lift`, and a network."""
    dataset = learning_dataset(root, ("a", "b"), n_views=N_VIEWS)
    _, world_from_cameras, images = pairs.views(2, 7)
    publish_views(dataset, "lift", pairs.K, world_from_cameras, images, Demonstration)

    def fill(out: Path) -> None:
        untrained().save(out)
        DescriptorNet.write(out, validated_on="nothing", metrics={}, curve=[(1, "loss", 0.0)])

    publish_artifact(dataset, DescriptorNet, "", fill)
    return dataset


def recordings_of(dataset: Dataset) -> dict[str, Recording]:
    scans = {name: Scan(dataset.path(Scan, name)) for name in dataset.items("scene")}
    return {**scans, "lift": Demonstration(dataset.path(Demonstration, "lift"))}


def frame(recording: str, i_frame: int) -> FrameName:
    return FrameName(recording, "wrist", i_frame)
