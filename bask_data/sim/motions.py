"""Motions shared by the scripted experts, and what makes an expert."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from bask_data.sim.operator import Operator, pointing_down
from bask_data.sim.world import World

ABOVE = 0.12
"""Height above an object from which it is approached, metres. Chosen for the objects of these tasks."""


@dataclass(frozen=True)
class Expert:
    """A task's script, its check of success, and the name of the body that it moves."""

    work: Callable[[Operator], None]
    is_done: Callable[[World], bool]
    moves: str


def raised(point: Float[ndarray, "3"], by: float) -> Float[ndarray, "3"]:
    """The point `by` metres higher."""
    return np.array([point[0], point[1], point[2] + by])


def pick(operator: Operator, at: Float[ndarray, "3"], yaw: float) -> None:
    """Approach a point from above with open fingers, and close them."""
    operator.move(to=pointing_down(raised(at, ABOVE), yaw))
    operator.move(to=pointing_down(at, yaw), slow=1.5)
    operator.wait(2)
    operator.grip(0.0)


def place(operator: Operator, at: Float[ndarray, "3"], yaw: float) -> None:
    """Put down the grasped object with the fingers at a point, and let go."""
    operator.move(to=pointing_down(np.array([at[0], at[1], operator.target[2, 3]]), yaw))
    operator.wait(2)
    operator.move(to=pointing_down(at, yaw), slow=1.5)
    operator.wait(3)
    release(operator)


def release(operator: Operator) -> None:
    """Open the fingers and move up."""
    operator.grip(0.08)
    operator.shift(z=ABOVE)


def free_spot(world: World, name: str, radius: float, rng: np.random.Generator) -> Float[ndarray, "2"]:
    """Position (x, y) on the table for an object of this radius, metres: the nearest with room, else the roomiest."""
    others = world.is_object_geom().copy()
    others[world.geoms_of(name)] = False
    centres, reach = world.data.geom_xpos[others, :2], world.model.geom_rbound[others]
    spots = rng.uniform((-0.30, -0.20), (0.30, 0.22), (300, 2))
    room = (np.linalg.norm(spots[:, None] - centres, axis=-1) - reach).min(axis=1) - radius
    roomy = np.flatnonzero(room > 0.03)
    # The nearest one, as a detour would only make the demonstration longer.
    here = world.world_from_body(name)[:2, 3]
    if len(roomy):
        return spots[roomy[np.argmin(np.linalg.norm(spots[roomy] - here, axis=1))]]
    return spots[np.argmax(room)]
