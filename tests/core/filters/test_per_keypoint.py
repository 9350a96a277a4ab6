from __future__ import annotations

import numpy as np
import pytest

from bask_data.core.filters.discrete import DiscreteSettings
from bask_data.core.filters.expectation import ExpectationSettings
from bask_data.core.filters.observation import Observation
from bask_data.core.filters.particle.settings import ParticleSettings
from bask_data.core.filters.per_keypoint import per_keypoint
from bask_data.core.filters.step import step
from bask_data.core.filters.table import FilterSettings

K = np.array([[60.0, 0, 19.5], [0, 60.0, 14.5], [0, 0, 1]])


def test_one_value_is_that_of_all_keypoints_and_several_are_one_for_each() -> None:
    np.testing.assert_array_equal(per_keypoint(2.0, 3, "alpha"), [2.0, 2.0, 2.0])
    np.testing.assert_array_equal(per_keypoint((1.0, 2.0), 2, "alpha"), [1.0, 2.0])


def test_values_for_another_number_of_keypoints_are_refused() -> None:
    with pytest.raises(ValueError, match="tau: expected one value, or one for each of 3 keypoints, got 2"):
        per_keypoint((0.1, 0.2), 3, "tau")


@pytest.mark.parametrize(
    "settings",
    [
        lambda alpha, _: ExpectationSettings(alpha=alpha),
        lambda alpha, ratio: DiscreteSettings(alpha=alpha, tau_ratio=ratio),
        lambda alpha, ratio: ParticleSettings(n_particles=300, alpha=alpha, tau_ratio=ratio),
        lambda alpha, ratio: ParticleSettings(n_particles=300, alpha=alpha, tau=ratio),
    ],
)
def test_keypoints_with_values_of_their_own_are_tracked_as_if_alone(settings) -> None:
    rng = np.random.default_rng(0)
    distance = rng.uniform(0.2, 2, (2, 30, 40)).astype(np.float32)
    depth, alphas, ratios = np.ones((30, 40), dtype=np.float32), (3.0, 9.0), (0.7, 0.1)

    def track(chosen: slice, given: FilterSettings) -> list[np.ndarray]:
        belief, own, estimates = None, np.random.default_rng(1), []
        for _ in range(4):
            seen = Observation(distance[chosen], depth, K, np.eye(4))
            belief, estimate = step(belief, [seen], None, own, given)
            estimates += [estimate.mean, estimate.log_evidence]
        return estimates

    together = track(slice(None), settings(alphas, ratios))
    for i in range(2):
        alone = track(slice(i, i + 1), settings(alphas[i], ratios[i]))
        for whole, one in zip(together, alone, strict=True):
            np.testing.assert_allclose(whole[i], one[0], rtol=1e-5, atol=1e-7)
