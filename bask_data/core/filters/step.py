"""One step of the filter that the settings belong to, for stored demonstrations and running robots alike.

    belief, estimate = step(belief, observations, motion, rng, settings)

is called once a frame, the first time with `belief = None`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from numpy.random import Generator

from bask_data.core.filters.observation import Estimate, Motion, Observation, nothing_known
from bask_data.core.filters.table import FilterSettings, filter_of


def step(
    belief: Any,
    observations: Sequence[Observation | None],
    motion: Motion | None,
    rng: Generator,
    settings: FilterSettings,
    k: int = 0,
) -> tuple[Any, Estimate]:
    """Belief and estimate after one more frame.

    Args:
        belief: returned by the last step with these settings; None before the first.
        observations: one for each camera, in the same order in every frame; None for a camera without a frame.
        motion: of the gripper since the last frame; None without one.
        rng: for filters that draw random numbers.
        k: number of keypoints, needed only while no camera has given a frame.

    Raises:
        ValueError: no filter has settings of this type.
    """
    if belief is None and all(seen is None for seen in observations):
        return None, nothing_known(len(observations), k)
    return filter_of(settings).step(belief, observations, motion, rng, settings)
