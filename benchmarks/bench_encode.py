"""Distance maps of a frame: one matrix product over descriptors with D first, against the usual ways.

The size of a frame of two cameras with a BASK network: 16 keypoints, D = 64, 256x256.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import torch

from bask_data.nn.network import DescriptorNetwork, NetworkSettings, distance_maps

D, K, HEIGHT, WIDTH = 64, 16, 256, 256


def cases() -> Iterator[tuple[str, Callable[[], object], Callable[[], object]]]:
    torch.manual_seed(0)
    descriptors, references = torch.randn(D, HEIGHT, WIDTH), torch.randn(K, D)
    last = descriptors.permute(1, 2, 0).contiguous()
    yield (
        "distance maps against a loop over keypoints",
        lambda: distance_maps(descriptors, references),
        lambda: torch.stack([(last - reference).norm(dim=-1) / D**0.5 for reference in references]),
    )
    network = DescriptorNetwork(NetworkSettings("resnet18", 16, 120)).eval()
    network.channels_last()
    rgb = np.random.default_rng(0).integers(0, 256, (480, 640, 3), dtype=np.uint8)
    whole = DescriptorNetwork(NetworkSettings("resnet18", 16, 480)).eval()
    found = torch.randn(K, 16).numpy()
    yield (
        "a frame described at 120x160, as the default network does, against 480x640",
        lambda: network.distance_maps(rgb, found),
        lambda: whole.distance_maps(rgb, found),
    )
