"""Accuracy of a network on matches it was not trained on."""

from __future__ import annotations

import math

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray

from bask_data.nn.network import DescriptorNetwork, best_matches, maps_of_cells
from bask_data.nn.sampling import PairSource


@torch.inference_mode()
def pixel_errors(
    network: DescriptorNetwork, source: PairSource, i_pairs: list[int], n_matches: int
) -> tuple[Float[ndarray, "n"], Float[ndarray, "n"]]:
    """Distance of the best match from the true one, in pixels of the second image and as a share of its diagonal.

    Args:
        i_pairs: indices of the pairs to use.
        n_matches: number of matches per pair, spaced evenly over its list.
    """
    pixels, shares = [], []
    for i_pair in i_pairs:
        pair = source.pair(i_pair)
        chosen = np.unique(np.linspace(0, len(pair.instance) - 1, n_matches).round().astype(int))
        queries = network.descriptors_at(pair.rgb_a, pair.uv_a[chosen])
        distances = maps_of_cells(network.cells(pair.rgb_b)[None], queries)[0]
        size = (pair.rgb_b.shape[0], pair.rgb_b.shape[1])
        error = np.linalg.norm(best_matches(distances, size) - pair.uv_b[chosen], axis=1)
        pixels.append(error)
        shares.append(error / math.hypot(*size))
    return np.concatenate(pixels), np.concatenate(shares)


def validation_metrics(
    network: DescriptorNetwork, source: PairSource, n_pairs: int = 16, n_matches: int = 64
) -> dict[str, float]:
    """Median pixel error, and PCK at 1, 2, 4 and 8 % of the image's diagonal, over `n_pairs` evenly spaced pairs."""
    i_pairs = np.unique(np.linspace(0, source.n_pairs - 1, n_pairs).round().astype(int)).tolist()
    pixels, shares = pixel_errors(network, source, i_pairs, n_matches)
    metrics = {"validation_median_error_px": float(np.median(pixels))}
    for percent in (1, 2, 4, 8):
        metrics[f"validation_pck_{percent}"] = float((shares <= percent / 100).mean())
    return metrics
