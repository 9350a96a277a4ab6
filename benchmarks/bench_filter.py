"""The filters on two cameras of 256x256, 16 keypoints and 64 dimensions of descriptor.

The first case is not the same work on both sides: it tells how much a filter step adds to the network's forward pass
before it. The bar is 15 %, a ratio of 6.7.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import torch

from bask_data.core.geometry import in_image, project
from bask_data.core.heatmap import Observation
from bask_data.core.particle_filter import ParticleSettings, first_particles, likelihood, particle_step
from bask_data.nn.network import DescriptorNetwork, NetworkSettings, distance_maps

SIZE, N_KEYPOINTS, DIMENSION = 256, 16, 64
SETTINGS = ParticleSettings(tau=0.1)


def frames() -> tuple[list[Observation], torch.Tensor, np.ndarray]:
    """Two views of a wall, descriptors (2, D, h, w) that change smoothly over it, and references (k, D)."""
    rng = np.random.default_rng(0)
    coarse = torch.from_numpy(rng.standard_normal((2, DIMENSION, 16, 16)).astype(np.float32))
    descriptors = torch.nn.functional.interpolate(coarse, size=(SIZE, SIZE), mode="bilinear")
    at = rng.integers(20, SIZE - 20, (N_KEYPOINTS, 2))
    references = descriptors[0][:, at[:, 1], at[:, 0]].T.numpy().copy()
    K = np.array([[220.0, 0, 127.5], [0, 220.0, 127.5], [0, 0, 1]])
    beside = np.eye(4)
    beside[0, 3] = 0.1
    depth = np.ones((SIZE, SIZE), dtype=np.float32)
    observations = [
        Observation(distance_maps(one, torch.from_numpy(references)).numpy(), depth, K, world_from_camera)
        for one, world_from_camera in zip(descriptors, (np.eye(4), beside), strict=True)
    ]
    return observations, descriptors, references


def look_up(
    points: np.ndarray, descriptors: list[np.ndarray], references: np.ndarray, observations: list[Observation]
) -> np.ndarray:
    """Likelihoods keypoint by keypoint: each particle's descriptor is looked up (h, w, D) and compared."""
    product = np.ones(points.shape[:2])
    for k in range(len(points)):
        for seen, image in zip(observations, descriptors, strict=True):
            uv, _ = project((points[k] - seen.world_from_camera[:3, 3]) @ seen.world_from_camera[:3, :3], seen.K)
            inside = in_image(uv, SIZE, SIZE)
            u, v = np.rint(np.where(inside[:, None], uv, 0)).astype(int).clip(0, SIZE - 1).T
            z = np.linalg.norm(image[v, u] - references[k], axis=1) / np.sqrt(DIMENSION)
            # The map is this keypoint's own, so that depth, occlusion and view are computed by the same code.
            alone = replace(seen, distance=np.zeros((1, 1, 1), dtype=np.float32))
            total, visible = likelihood(points[k : k + 1], alone, SETTINGS)
            product[k] *= (total - visible + visible * np.exp(-SETTINGS.alpha * z))[0]
    return product


def cases() -> Iterator[tuple[str, Callable[[], object], Callable[[], object]]]:
    """One step against the forward pass, maps and likelihoods against loops."""
    observations, descriptors, references = frames()
    rng = np.random.default_rng(0)
    belief, _ = particle_step(None, observations, None, rng)
    network = DescriptorNetwork(NetworkSettings("resnet18", descriptor_dim=DIMENSION, height=SIZE)).eval()
    images = rng.integers(0, 256, (2, SIZE, SIZE, 3), dtype=np.uint8)

    def step() -> object:
        return particle_step(belief, observations, None, np.random.default_rng(1))

    yield "particle step, 2000 particles (ResNet-18 forward pass is plain)", step, lambda: network.cells(images)

    points = first_particles(observations, rng, SETTINGS)[0]
    channels_last = [np.ascontiguousarray(one.permute(1, 2, 0).numpy()) for one in descriptors]
    wanted = torch.from_numpy(references)

    def maps_and_likelihoods() -> np.ndarray:
        product = np.ones(points.shape[:2])
        for seen, one in zip(observations, descriptors, strict=True):
            with_maps = replace(seen, distance=distance_maps(one, wanted).numpy())
            product *= likelihood(points, with_maps, SETTINGS)[0]
        return product

    yield (
        "distance maps and likelihoods of 16 keypoints (loop of look-ups is plain)",
        maps_and_likelihoods,
        lambda: look_up(points, channels_last, references, observations),
    )
