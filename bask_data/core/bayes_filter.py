"""One step of any of the filters, chosen by its settings: the same call for a stored demonstration and for a running
robot.

    belief, estimate = step(belief, observations, motion, rng, settings)

starts with `belief = None`, once a frame.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal, get_args

from numpy.random import Generator

from bask_data.core.discrete_filter import DiscreteBelief, DiscreteSettings, discrete_step
from bask_data.core.heatmap import (
    Estimate,
    ExpectationSettings,
    Motion,
    Observation,
    expectation_step,
    nothing_known,
)
from bask_data.core.particle_filter import ParticleBelief, ParticleSettings, particle_step

__all__ = [
    "Belief",
    "DiscreteSettings",
    "Estimate",
    "ExpectationSettings",
    "Filter",
    "Motion",
    "Named",
    "Observation",
    "ParticleSettings",
    "Settings",
    "settings_named",
    "step",
]

Settings = ExpectationSettings | DiscreteSettings | ParticleSettings
Belief = Estimate | DiscreteBelief | ParticleBelief
"""What a filter knows after a frame, and all it needs to know for the next one."""
Filter = Literal["expectation", "discrete", "particle"]
Named = Literal["default", "paper", "code"]

_OUT_OF_SIGHT = 0.25 * math.exp(-4.0)
"""tau of the authors' code: a match at descriptor distance 1 whose depth fits with 0.25."""
_CODE: dict[Filter, Settings] = {
    "expectation": ExpectationSettings(alpha=4.0),
    "discrete": DiscreteSettings(alpha=4.0, walk_px=2.0, tau=0.0, restart=0.0, gripper_probability=0.0),
    "particle": ParticleSettings(
        n_particles=250,
        alpha=4.0,
        tau=_OUT_OF_SIGHT,
        walk=0.01,
        gripper_probability=0.25,
        gripper_memory=0.0,
        gripper_reach=math.inf,
        gripper_turns=False,
        depth_noise=0.02,
        depth_noise_floor=0.001,
        hidden_without_depth=1.0,
        occlusion_margin=0.10,
        resample_below=0.1,
        resampling="stratified",
        draw_sharpness=1.0,
        redraw_share=0.05,
        redraw_mass=0.05,
        n_lookalikes=0,
    ),
}


def settings_named(filter: Filter, name: Named = "default", **overrides: Any) -> Settings:
    """Settings of a filter: our own, the paper's or those of its authors' published code.

    The paper leaves most values open; what it does not say is as in the code.

    Args:
        overrides: fields to change; those that are None stay as they are.

    Raises:
        ValueError: there is no such filter, or no settings of that name.
    """
    if filter not in get_args(Filter) or name not in get_args(Named):
        known = f"one of {', '.join(get_args(Filter))} and one of {', '.join(get_args(Named))}"
        raise ValueError(f"settings: expected {known}, got {filter} and {name}")
    own: dict[Filter, Settings] = {
        "expectation": ExpectationSettings(),
        "discrete": DiscreteSettings(),
        "particle": ParticleSettings(),
    }
    settings = own[filter] if name == "default" else _CODE[filter]
    if name == "paper" and isinstance(settings, ParticleSettings):
        settings = replace(settings, occlusion_margin=0.05, hidden_without_depth=0.5)
    return replace(settings, **{field: value for field, value in overrides.items() if value is not None})


def step(
    belief: Any,
    observations: Sequence[Observation | None],
    motion: Motion | None,
    rng: Generator,
    settings: Settings,
    k: int = 0,
) -> tuple[Belief | None, Estimate]:
    """Belief and estimate after one more frame.

    Args:
        belief: what the last step with these settings returned; None before the first.
        observations: one for each camera, in the same order in every frame; None for a camera that gave no frame.
        motion: of the gripper since the last frame, if there is one.
        rng: used by the particle filter only.
        k: number of keypoints, asked for only while no camera has given a frame yet.
    """
    if belief is None and all(seen is None for seen in observations):
        return None, nothing_known(len(observations), k)
    if isinstance(settings, ParticleSettings):
        return particle_step(belief, observations, motion, rng, settings)
    if isinstance(settings, DiscreteSettings):
        return discrete_step(belief, observations, motion, rng, settings)
    return expectation_step(belief, observations, motion, rng, settings)
