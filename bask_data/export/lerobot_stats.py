"""Statistics of a LeRobot dataset, by feature: of values, of images, and of several episodes together."""

from __future__ import annotations

from typing import Any

import numpy as np

QUANTILES = (0.01, 0.10, 0.50, 0.90, 0.99)
"""Quantiles among the statistics of format v3.0."""


def vector_stats(values: np.ndarray) -> dict[str, Any]:
    """Statistics of an episode's values (t, w) or (t,), each a list of w."""
    columns = values.reshape(len(values), -1).astype(np.float64)
    stats = {"min": columns.min(0), "max": columns.max(0), "mean": columns.mean(0), "std": columns.std(0)}
    stats |= {_quantile_name(share): np.quantile(columns, share, axis=0) for share in QUANTILES}
    return {**{name: value.tolist() for name, value in stats.items()}, "count": [len(values)]}


def image_stats(counts: np.ndarray, n_images: int, step: float = 1 / 255) -> dict[str, Any]:
    """Statistics of images, each (c, 1, 1), by default with brightness from 0 to 1.

    Args:
        counts: (c, 256) or (c, 65536) histograms of the channels.
        step: from one value of a channel to the next.
    """
    brightness = np.arange(counts.shape[1]) * step
    share = counts / counts.sum(axis=1, keepdims=True)
    occurs = counts > 0
    mean = share @ brightness
    stats = {
        "min": brightness[occurs.argmax(axis=1)],
        "max": brightness[counts.shape[1] - 1 - occurs[:, ::-1].argmax(axis=1)],
        "mean": mean,
        "std": np.sqrt(np.maximum(share @ brightness**2 - mean**2, 0.0)),
    }
    reached = share.cumsum(axis=1)
    # The tolerance covers the rounding of the cumulative sums.
    stats |= {_quantile_name(q): brightness[(reached >= q - 1e-12).argmax(axis=1)] for q in QUANTILES}
    return {**{name: value.reshape(-1, 1, 1).tolist() for name, value in stats.items()}, "count": [n_images]}


def merged_stats(episodes: list[dict[str, Any]]) -> dict[str, Any]:
    """Statistics of all episodes from those of each: exact except for quantiles, which are averaged as in LeRobot."""
    counts = np.array([stats["count"][0] for stats in episodes], dtype=np.float64)
    names = [name for name in episodes[0] if name != "count"]
    of = {name: np.array([stats[name] for stats in episodes], dtype=np.float64) for name in names}

    def averaged(values: np.ndarray) -> np.ndarray:
        mean: np.ndarray = np.average(values, axis=0, weights=counts)
        return mean

    mean = averaged(of["mean"])
    merged = {name: averaged(of[name]) for name in of if name.startswith("q")}
    merged |= {"min": of["min"].min(axis=0), "max": of["max"].max(axis=0), "mean": mean}
    merged["std"] = np.sqrt(averaged(of["std"] ** 2 + (of["mean"] - mean) ** 2))
    return {**{name: value.tolist() for name, value in merged.items()}, "count": [int(counts.sum())]}


def _quantile_name(share: float) -> str:
    return f"q{round(share * 100):02d}"
