"""The filters on two cameras of 256x256, 16 keypoints and descriptors of 64 dimensions.

The two sides of two cases do not do the same work. The first shows what a filter step adds to the network's forward
pass; target: 15 %, a ratio of 6.7. The last compares the step on ready maps with making the maps; target: 1 or more.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import torch

from bask_data.core.filters.observation import Observation
from bask_data.core.filters.particle import particle_step
from bask_data.core.filters.particle.belief import ParticleBelief
from bask_data.core.filters.particle.settings import ParticleSettings
from bask_data.nn.network import DescriptorNetwork, NetworkSettings, distance_maps, maps_of_cells

SIZE, N_KEYPOINTS, DIMENSION = 256, 16, 64
SETTINGS = ParticleSettings()
SMALL = 2
"""A loop of look-ups needs no whole maps: every so many-th pixel is enough for tau and for new particles."""


def frames() -> tuple[list[Observation], torch.Tensor, torch.Tensor]:
    """Two views of a wall, cells (2, D, h/8, w/8) as a network gives them, and references (k, D)."""
    rng = np.random.default_rng(0)
    cells = torch.from_numpy(rng.standard_normal((2, DIMENSION, SIZE // 8, SIZE // 8)).astype(np.float32))
    at = torch.from_numpy(rng.integers(3, SIZE // 8 - 3, (N_KEYPOINTS, 2)))
    references = cells[0][:, at[:, 1], at[:, 0]].T.contiguous()
    K = np.array([[220.0, 0, 127.5], [0, 220.0, 127.5], [0, 0, 1]])
    beside = np.eye(4)
    beside[0, 3] = 0.1
    depth = np.ones((SIZE, SIZE), dtype=np.float32)
    maps = maps_of_cells(cells, references).numpy()
    observations = [
        Observation(one, depth, K, world_from_camera)
        for one, world_from_camera in zip(maps, (np.eye(4), beside), strict=True)
    ]
    return observations, cells, references


def one_keypoint(belief: ParticleBelief, i: int) -> ParticleBelief:
    """The belief of a keypoint by itself."""
    return ParticleBelief(**{name: value[i : i + 1] for name, value in vars(belief).items()})


def looked_up(images: torch.Tensor, reference: torch.Tensor) -> np.ndarray:
    """Distances (2, 1, h, w) of some pixels, each descriptor looked up (2, h, w, D) and compared."""
    some = images[:, ::SMALL, ::SMALL]
    return ((some - reference).norm(dim=-1) / DIMENSION**0.5)[:, None].numpy()


def cases() -> Iterator[tuple[str, Callable[[], object], Callable[[], object]]]:
    """One step against the forward pass, against a loop of look-ups, and against the maps."""
    observations, cells, references = frames()
    rng = np.random.default_rng(0)
    belief, _ = particle_step(None, observations, None, rng, SETTINGS)
    assert belief is not None
    network = DescriptorNetwork(NetworkSettings("resnet18", descriptor_dim=DIMENSION, height=SIZE)).eval()
    images = rng.integers(0, 256, (2, SIZE, SIZE, 3), dtype=np.uint8)

    def step() -> object:
        return particle_step(belief, observations, None, np.random.default_rng(1), SETTINGS)

    yield "particle step, 2000 particles (ResNet-18 forward pass is plain)", step, lambda: network.cells(images)

    def maps_and_step() -> object:
        maps = maps_of_cells(cells, references).numpy()
        seen = [replace(one, distance=distance) for one, distance in zip(observations, maps, strict=True)]
        return particle_step(belief, seen, None, np.random.default_rng(1), SETTINGS)

    def loop() -> object:
        upsampled = torch.nn.functional.interpolate(cells, size=(SIZE, SIZE), mode="bilinear").permute(0, 2, 3, 1)
        estimates = []
        for i in range(N_KEYPOINTS):
            distance = looked_up(upsampled, references[i])
            seen = [replace(one, distance=here) for one, here in zip(observations, distance, strict=True)]
            estimates.append(particle_step(one_keypoint(belief, i), seen, None, np.random.default_rng(1), SETTINGS))
        return estimates

    yield "distance maps and step of 16 keypoints (keypoint by keypoint, look-ups, is plain)", maps_and_step, loop
    last = torch.nn.functional.interpolate(cells, size=(SIZE, SIZE), mode="bilinear")
    yield (
        "step on ready maps (the maps, from descriptors of all pixels, are plain)",
        step,
        lambda: [distance_maps(one, references) for one in last],
    )
