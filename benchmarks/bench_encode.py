"""`encode` of two cameras of 256x256 against the bare forward pass of the network, and against its distance maps.

16 keypoints, D = 64, ResNet-18, 2000 particles: the size of a BASK network. The two sides of the first case do not do
the same work: it shows what `encode` costs on top of the network. Target: 1.15 times as long, a ratio of 0.87.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import torch

from bask_data.kinds import CameraFrames, Demonstration, DescriptorNet, Pick, ReferenceKeypoints
from bask_data.nn.network import DescriptorNetwork, NetworkSettings, distance_maps, maps_of_cells
from bask_data.nn.resnet import upsampled
from bask_data.stages.encode import EncodeParams, encode

D, K, SIZE, N_FRAMES = 64, 16, 256, 24


def cases() -> Iterator[tuple[str, Callable[[], object], Callable[[], object]]]:
    torch.manual_seed(0)
    with tempfile.TemporaryDirectory() as folder:
        yield _whole(Path(folder))
    cells, references = torch.randn(1, D, SIZE // 8, SIZE // 8), torch.randn(K, D)
    descriptors = upsampled(cells, (SIZE, SIZE))[0]
    last = descriptors.permute(1, 2, 0).contiguous()
    yield (
        "distance maps of ready descriptors against a loop over keypoints",
        lambda: distance_maps(descriptors, references),
        lambda: torch.stack([(last - reference).norm(dim=-1) / D**0.5 for reference in references]),
    )
    yield (
        "distance maps from the network's cells against up-sampling, then one product",
        lambda: maps_of_cells(cells, references),
        lambda: distance_maps(upsampled(cells, (SIZE, SIZE))[0], references),
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


def _whole(folder: Path) -> tuple[str, Callable[[], object], Callable[[], object]]:
    images = _demonstration(folder / "demonstration")
    network = DescriptorNetwork(NetworkSettings("resnet18", D, SIZE)).eval()
    network.channels_last()
    (folder / "descriptor").mkdir()
    network.save(folder / "descriptor")
    uv = np.random.default_rng(0).uniform(20, SIZE - 20, (K, 2)).astype(np.float32)
    picks = [Pick(name=f"k{i}", recording="a", camera="wrist", frame=0, u=0, v=0) for i in range(K)]
    descriptors = network.descriptors_at(images[0, 0], uv).numpy()
    ReferenceKeypoints.write(folder / "reference", descriptors=descriptors, picks=picks)
    inputs = (
        Demonstration(folder / "demonstration"),
        DescriptorNet(folder / "descriptor"),
        ReferenceKeypoints(folder / "reference"),
    )

    def ours() -> None:
        (folder / "out").mkdir()
        encode(*inputs, truths=[], params=EncodeParams(), out=folder / "out")
        shutil.rmtree(folder / "out")

    def forward() -> None:
        # Loading the network is part of encoding, but not of what it costs a frame.
        again = inputs[1].network()
        for both in images:
            again.cells(both)

    return f"encode, {N_FRAMES} frames of 2 cameras (the network's forward passes are plain)", ours, forward


def _demonstration(out: Path) -> np.ndarray:
    """Two cameras that circle over a wall of random squares; its images (t, c, h, w, 3)."""
    rng = np.random.default_rng(0)
    squares = rng.integers(0, 256, (2 * SIZE // 16, 2 * SIZE // 16, 3), dtype=np.uint8)
    wall = squares.repeat(16, axis=0).repeat(16, axis=1)
    group = Demonstration.start(out, "benchmark", {})
    images = np.empty((N_FRAMES, 2, SIZE, SIZE, 3), np.uint8)
    for i_camera, name in enumerate(("side", "wrist")):
        # A pixel of the wall is a millimetre, at a metre's distance and a focal length of a thousand pixels.
        at = (SIZE // 2 * (1 + 0.5 * np.sin(np.arange(N_FRAMES) / 4 + i_camera))).astype(int)
        transforms = np.tile(np.eye(4), (N_FRAMES, 1, 1))
        transforms[:, 0, 3] = at / 1000
        images[:, i_camera] = [wall[:SIZE, u : u + SIZE] for u in at]
        Demonstration.write_camera(
            group,
            name,
            CameraFrames(
                K=np.array([[1000.0, 0, 127.5], [0, 1000.0, 127.5], [0, 0, 1]]),
                world_from_cameras=transforms,
                time=np.arange(N_FRAMES) / 30,
                depth_scale=1e-4,
                size=(SIZE, SIZE),
                read=lambda i, of=i_camera: (images[i, of], np.full((SIZE, SIZE), 10_000, np.uint16)),
            ),
        )
    return images
