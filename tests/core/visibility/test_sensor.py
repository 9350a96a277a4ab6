from __future__ import annotations

import numpy as np
import pytest

from bask_data.core.visibility.sensor import noise, residuals, tolerance_of
from tests.scenes import Scene, Sphere, orbit
from tests.two_boxes import (
    BACK,
    DIRECTIONS,
    FRONT,
    HEIGHT,
    SCENE,
    WIDTH,
    K,
    mesh_of,
)


@pytest.mark.parametrize(("a", "b"), [(0.001, 0.005), (0.001, 0.02), (0.003, 0.0), (0.0, 0.01)])
def test_the_noise_of_a_sensor_is_recovered_within_a_fifth(a: float, b: float) -> None:
    surface, rng, samples = mesh_of((FRONT, BACK), [1, 2]), np.random.default_rng(0), []
    hand = Sphere((0.03, -0.25, 0.12), 0.05)
    for camera in orbit(12, radius=0.8):
        # The hand is an outlier the mesh does not know.
        depth = Scene((*SCENE.objects, hand), SCENE.background).render(K, camera, HEIGHT, WIDTH).depth
        off = rng.normal(size=depth.shape) * (a + b * depth)
        measured = np.where(depth > 0, depth + off, 0).astype(np.float32)
        samples.append(residuals(surface, measured, DIRECTIONS, camera))
    found = noise(np.concatenate(samples))
    assert found is not None
    for z in (0.6, 0.8, 1.0):
        assert found[0] + found[1] * z == pytest.approx(a + b * z, rel=0.2)


def test_the_tolerance_follows_the_noise_between_what_the_mesh_and_a_hand_allow() -> None:
    assert noise(np.zeros((10, 2), np.float32)) is None
    assert tolerance_of(None, 0.004) == (0.01, 0.02)
    assert tolerance_of((0.0, 0.0), 0.004) == (0.014, 0.0)
    assert tolerance_of((0.005, 0.005), 0.004) == (0.02, 0.02)
    assert tolerance_of((1.0, 1.0), 0.004) == (0.04, 0.06)
