"""One step of any of the filters, chosen by its settings: the same call for a stored demonstration and for a running
robot.

    belief, estimate = step(belief, observations, motion, rng, settings)

starts with `belief = None`, once a frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from numpy.random import Generator

from bask_data.core.discrete_filter import DiscreteBelief, DiscreteSettings, discrete_step
from bask_data.core.heatmap import Estimate, ExpectationSettings, Motion, Observation, expectation_step
from bask_data.core.particle_filter import ParticleBelief, ParticleSettings, particle_step

__all__ = [
    "Belief",
    "DiscreteSettings",
    "Estimate",
    "ExpectationSettings",
    "Motion",
    "Observation",
    "ParticleSettings",
    "Settings",
    "step",
]

Settings = ExpectationSettings | DiscreteSettings | ParticleSettings
Belief = Estimate | DiscreteBelief | ParticleBelief
"""What a filter knows after a frame, and all it needs to know for the next one."""


def step(
    belief: Any, observations: Sequence[Observation], motion: Motion | None, rng: Generator, settings: Settings
) -> tuple[Belief | None, Estimate]:
    """Belief and estimate after one more frame.

    Args:
        belief: what the last step with these settings returned; None before the first.
        observations: one for each camera, in the same order in every frame.
        motion: of the gripper since the last frame, if there is one.
        rng: used by the particle filter only.
    """
    if isinstance(settings, ParticleSettings):
        return particle_step(belief, observations, motion, rng, settings)
    if isinstance(settings, DiscreteSettings):
        return discrete_step(belief, observations, motion, rng, settings)
    return expectation_step(belief, observations, motion, rng, settings)
