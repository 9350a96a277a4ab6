"""The belief of the particle filter: for each keypoint, weighted points in the world frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray


@dataclass(frozen=True)
class ParticleBelief:
    """Weighted points; the weights of each keypoint sum to one."""

    points_world: Float[ndarray, "k n 3"]
    weight: Float[ndarray, "k n"]
    held: Bool[ndarray, "k n"]
    """Whether a particle took part in the gripper's last motion."""
    lookalikes: Float[ndarray, "k m 3"]
    """Positions of distractors, the latest first; NaN where there are fewer than m."""
    lookalike_match: Float[ndarray, "k m"]
    """exp(-alpha z) of each."""
    usual_match: Float[ndarray, "k"]
    """Running average of p_d p_c of the track while it is seen; 0 where it never was."""
    slope: Float[ndarray, "k"]
    """Running average of the slope of `Residuals`, per metre; NaN before the first."""
    displacement: Float[ndarray, "k"]
    """Running average of the distance, metres, that explains the residual of the mean; NaN before the first."""


def new_belief(
    points_world: Float[ndarray, "k n 3"], weight: Float[ndarray, "k n"], n_lookalikes: int = 0
) -> ParticleBelief:
    """Particles that do not move with the gripper, and no distractors."""
    k = len(points_world)
    nowhere = np.full((k, n_lookalikes, 3), np.nan)
    held = np.zeros(weight.shape, dtype=bool)
    unknown = np.full(k, np.nan)
    return ParticleBelief(
        points_world, weight, held, nowhere, np.zeros((k, n_lookalikes)), np.zeros(k), unknown, unknown
    )


def normalised(log_weight: Float[ndarray, "k n"]) -> tuple[Float[ndarray, "k n"], Float[ndarray, "k"]]:
    """Weights that sum to one, and the log of their sum before."""
    highest = log_weight.max(axis=1, keepdims=True)
    weight = np.exp(log_weight - highest)
    total = weight.sum(axis=1, keepdims=True)
    return weight / total, (np.log(total) + highest)[:, 0]
