"""The filters of `core.bayes_filter` on tensors, on a CPU or a CUDA device.

Step by step the same: given the same belief, observations and generator, whose random numbers NumPy draws, both give
the same to rounding. Everything but the distance maps is float64.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from numpy.random import Generator

from bask_data.core.bayes_filter import Belief, DiscreteSettings, Motion, ParticleSettings, Settings
from bask_data.core.discrete_filter import DiscreteBelief
from bask_data.core.particle_filter import ParticleBelief
from bask_data.nn.filters.discrete import (
    TensorDiscreteBelief,
    discrete_belief_from,
    discrete_belief_on,
    discrete_step,
)
from bask_data.nn.filters.frames import (
    TensorEstimate,
    TensorObservation,
    estimate_from,
    estimate_on,
    nothing_known,
    observation_on,
)
from bask_data.nn.filters.heatmap import expectation_step
from bask_data.nn.filters.particle import TensorParticleBelief, particle_belief_from, particle_belief_on, particle_step

__all__ = [
    "TensorBelief",
    "TensorDiscreteBelief",
    "TensorEstimate",
    "TensorObservation",
    "TensorParticleBelief",
    "belief_from",
    "belief_on",
    "estimate_from",
    "observation_on",
    "step",
]


TensorBelief = TensorEstimate | TensorDiscreteBelief | TensorParticleBelief
"""What a filter knows after a frame, on a device."""


def belief_on(belief: Belief, device: torch.device | str = "cpu") -> TensorBelief:
    """Any filter's belief on a device."""
    if isinstance(belief, ParticleBelief):
        return particle_belief_on(belief, device)
    if isinstance(belief, DiscreteBelief):
        return discrete_belief_on(belief, device)
    return estimate_on(belief, device)


def belief_from(belief: TensorBelief) -> Belief:
    """Any filter's belief back from its device."""
    if isinstance(belief, TensorParticleBelief):
        return particle_belief_from(belief)
    if isinstance(belief, TensorDiscreteBelief):
        return discrete_belief_from(belief)
    return estimate_from(belief)


def step(
    belief: Any,
    observations: Sequence[TensorObservation | None],
    motion: Motion | None,
    rng: Generator,
    settings: Settings,
    k: int = 0,
    device: torch.device | str = "cpu",
) -> tuple[TensorBelief | None, TensorEstimate]:
    """Belief and estimate after one more frame: `core.bayes_filter.step` on tensors.

    Args:
        k: number of keypoints, asked for only while no camera has given a frame yet, as is `device`.
    """
    if belief is None and all(seen is None for seen in observations):
        return None, nothing_known(len(observations), k, device)
    if isinstance(settings, ParticleSettings):
        return particle_step(belief, observations, motion, rng, settings)
    if isinstance(settings, DiscreteSettings):
        return discrete_step(belief, observations, motion, settings)
    return expectation_step(belief, observations, settings)
