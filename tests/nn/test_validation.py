from __future__ import annotations

import numpy as np
import pytest
import torch

from bask_data.nn.network import DescriptorNetwork, NetworkSettings
from bask_data.nn.validation import pixel_errors, validation_metrics
from tests.nn.pairs import ScenePairs


class Positions(torch.nn.Module):
    """Describes each cell by the position of its centre."""

    def __init__(self, shift: float = 0.0) -> None:
        super().__init__()
        self.shift = torch.nn.Parameter(torch.tensor(shift))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        v, u = torch.meshgrid(torch.arange(12.0), torch.arange(16.0), indexing="ij")
        return torch.stack([8 * u + 3.5, 8 * v + 3.5])[None] + self.shift


def network_of_positions() -> DescriptorNetwork:
    network = DescriptorNetwork(NetworkSettings("resnet18", descriptor_dim=2, height=96))
    network.encoder = Positions()
    return network


def position_errors(i_pairs: list[int]) -> np.ndarray:
    """Errors of such a network: it finds the position of the query, not that of the match."""
    source = ScenePairs(n_views=2)
    pairs = [source.pair(i) for i in i_pairs]
    return np.concatenate([np.linalg.norm(pair.uv_a.clip(3.5, [123.5, 91.5]) - pair.uv_b, axis=1) for pair in pairs])


def test_pixel_errors_are_measured_in_pixels_of_the_image():
    pixels, shares = pixel_errors(network_of_positions(), ScenePairs(n_views=2), [0], 10_000)
    np.testing.assert_allclose(pixels, position_errors([0]), atol=1.0)
    np.testing.assert_allclose(shares, pixels / 160)


def test_metrics_are_the_median_and_shares_of_the_errors():
    metrics = validation_metrics(network_of_positions(), ScenePairs(n_views=2), n_pairs=2, n_matches=10_000)
    errors = position_errors([0, 1])
    assert metrics["validation_median_error_px"] == pytest.approx(np.median(errors), abs=1.0)
    for percent in (1, 2, 4, 8):
        # Errors are known to a pixel, so PCK lies between its values at thresholds one pixel lower and higher.
        limit = percent / 100 * 160
        low, high = (errors <= limit - 1).mean(), (errors <= limit + 1).mean()
        assert low <= metrics[f"validation_pck_{percent}"] <= high
    assert 0 < metrics["validation_pck_8"] < 1
