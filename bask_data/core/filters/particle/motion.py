"""Motion of particles between two frames: a random walk, and for some of them the gripper's motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.random import Generator

from bask_data.core.filters.observation import Motion
from bask_data.core.filters.particle.belief import ParticleBelief
from bask_data.core.filters.particle.settings import ParticleSettings
from bask_data.core.geometry import invert_rigid, transform


def move(belief: ParticleBelief, motion: Motion | None, rng: Generator, settings: ParticleSettings) -> ParticleBelief:
    """The belief predicted for the next frame.

    x + m_r + m_w G_t, with G_t the gripper's rigid motion, rotation included. m_w is redrawn in each frame with
    probability 1 - `gripper_memory`, else kept: a Markov chain whose share of ones is p_w.

    Source: von Hartz et al. 2023, Eq. 4.
    """
    points_world = belief.points_world
    n = points_world.shape[1]
    walked = points_world + settings.walk * rng.standard_normal((n, 3))
    drawn_anew, takes_part = rng.random(n) >= settings.gripper_memory, rng.random(n) < settings.gripper_probability
    if motion is None:
        return replace(belief, points_world=walked)
    now_from_before = motion.world_from_gripper @ invert_rigid(motion.world_from_gripper_before)
    position = motion.world_from_gripper_before[:3, 3]
    near = np.linalg.norm(points_world - position, axis=-1) < settings.gripper_reach
    held = near & np.where(drawn_anew, takes_part, belief.held)
    if settings.gripper_turns:
        carried = transform(now_from_before, points_world) - points_world
    else:
        carried = np.broadcast_to(motion.world_from_gripper[:3, 3] - position, points_world.shape)
    return replace(belief, points_world=walked + carried * held[..., None], held=held)
