"""The estimate from single frames: the expectation of each camera's heat map, lifted to 3D."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from numpy.random import Generator

from bask_data.core.filters.heatmap import Lifted, fuse, keep_last, lift, softmax_map
from bask_data.core.filters.observation import Estimate, Motion, Observation, PixelMaps, fitted, n_keypoints
from bask_data.core.filters.table import Filter, FilterSettings, PerKeypoint


@dataclass(frozen=True)
class ExpectationSettings(FilterSettings):
    """Settings of the estimate from single frames. The paper's alpha is 4."""

    alpha: PerKeypoint = 20.0
    """Temperature: a pixel at descriptor distance z has weight exp(-alpha z). With a lower one, the many pixels of
    background outweigh the match."""


def expectation_step(
    belief: Estimate | None,
    observations: Sequence[Observation | None],
    motion: Motion | None = None,
    rng: Generator | None = None,
    settings: ExpectationSettings = ExpectationSettings(),
) -> tuple[Estimate, Estimate]:
    """The expectation of each heat map, lifted to 3D and fused over the cameras.

    Each frame by itself; the last estimate is kept only where no camera has depth. `motion` and `rng` are unused: every
    filter has the same signature.

    Source: von Hartz et al. 2023, Sec. III-A.3.
    """
    lifted: list[Lifted | None] = []
    for seen in observations:
        if seen is None:
            lifted.append(None)
            continue
        z = fitted(seen)
        heat, log_evidence = softmax_map(z.distance, settings.alpha)
        lifted.append(lift(heat, z, log_evidence))
    k = n_keypoints(observations) if belief is None else len(belief.mean)
    estimate = keep_last(fuse(lifted, k), belief, observations)
    return estimate, estimate


def heat_maps(
    belief: Estimate | None, observations: Sequence[Observation | None], settings: ExpectationSettings
) -> PixelMaps:
    """The heat maps of the cameras that gave a frame."""
    return PixelMaps(
        tuple(None if seen is None else softmax_map(seen.distance, settings.alpha)[0] for seen in observations)
    )


FILTER = Filter(
    settings=ExpectationSettings,
    belief=Estimate,
    step=expectation_step,
    hypotheses=heat_maps,
    presets={"paper": {"alpha": 4.0}, "code": {"alpha": 4.0}},
    by_single_frames=True,
)
