"""A filter from outside of the package: the most likely pixel of the first camera, smoothed over time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator

from bask_data.core.filters.heatmap import fuse, keep_last, lift, softmax_map
from bask_data.core.filters.observation import Estimate, Motion, Observation, PixelMaps, fitted
from bask_data.core.filters.table import Filter, FilterSettings


@dataclass(frozen=True)
class ToySettings(FilterSettings):
    """Settings of the toy filter."""

    alpha: float = 30.0
    """Temperature of the heat map."""
    walk: float = 0.5
    """Share of the last place that is kept. (Options of `encode` are found by name, so this one is `--walk`.)"""


@dataclass(frozen=True)
class ToyBelief:
    """The last estimate, and how many frames it is made of."""

    estimate: Estimate
    n_frames: np.ndarray


def toy_step(
    belief: ToyBelief | None,
    observations: Sequence[Observation | None],
    motion: Motion | None,
    rng: Generator,
    settings: ToySettings,
) -> tuple[ToyBelief, Estimate]:
    """The mode of this frame's heat maps, and a share of the last mean."""
    lifted = []
    for seen in observations:
        if seen is None:
            lifted.append(None)
            continue
        heat, log_evidence = softmax_map(fitted(seen).distance, settings.alpha)
        lifted.append(lift(heat, fitted(seen), log_evidence))
    k = next(len(seen.distance) for seen in observations if seen is not None) if belief is None else len(_mean(belief))
    now = keep_last(fuse(lifted, k), belief.estimate if belief else None, observations)
    mean = now.mean if belief is None else (1 - settings.walk) * now.mean + settings.walk * _mean(belief)
    estimate = Estimate(**{**vars(now), "mean": mean})
    return ToyBelief(estimate, np.array(1 if belief is None else belief.n_frames + 1)), estimate


def _mean(belief: ToyBelief) -> np.ndarray:
    return belief.estimate.mean


def toy_maps(belief: ToyBelief | None, observations: Sequence[Observation | None], settings: ToySettings) -> PixelMaps:
    """The heat map of each camera."""
    return PixelMaps(
        tuple(None if one is None else softmax_map(one.distance, settings.alpha)[0] for one in observations)
    )


FILTER = Filter(settings=ToySettings, belief=ToyBelief, step=toy_step, hypotheses=toy_maps)
