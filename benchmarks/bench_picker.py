"""Heat maps of the picker, seven frames for each move of the pointer: from descriptors at stride 8, or from full ones.

The size of a page with a BASK network: D = 64, 256x256. The target is what people perceive as immediate, 100 ms, and
the browser needs a part of that.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from types import SimpleNamespace

import numpy as np
import torch

from bask_data.nn.network import DescriptorNetwork, NetworkSettings, distance_maps
from bask_data.picker.gallery import FrameName, Gallery

D, HEIGHT, WIDTH, N_FRAMES = 64, 256, 256, 7


def cases() -> Iterator[tuple[str, Callable[[], object], Callable[[], object]]]:
    torch.manual_seed(0)
    rng = np.random.default_rng(0)
    images = rng.integers(0, 256, (N_FRAMES, HEIGHT, WIDTH, 3), dtype=np.uint8)
    network = DescriptorNetwork(NetworkSettings("resnet18", D, HEIGHT)).eval()
    camera = SimpleNamespace(name="wrist", n_frames=N_FRAMES, height=HEIGHT, width=WIDTH, rgb=lambda i: images[i])
    gallery = Gallery({"a": SimpleNamespace(cameras=[camera], scope="scene")}, network)  # type: ignore[dict-item]
    frames = [FrameName("a", "wrist", i) for i in range(N_FRAMES)]
    for frame in frames:
        gallery.describe(frame)
    full = [network.describe(image) for image in images]

    def ours() -> object:
        descriptor = gallery.descriptor_at(frames[0], 100.0, 120.0)
        return [gallery.find(descriptor, frame).z for frame in frames]

    def plain() -> object:
        return [distance_maps(one, full[0][:, 120, 100][None]).numpy() for one in full]

    yield "heat maps of seven frames", ours, plain
