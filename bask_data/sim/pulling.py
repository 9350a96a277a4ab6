"""The expert of the task `drawer`: it pulls a drawer open by its handle."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from bask_data.sim.cabinet import STANDOFF
from bask_data.sim.motions import raised
from bask_data.sim.operator import Operator, pointing_down
from bask_data.sim.world import World

AROUND_BAR = 0.028
"""Opening of the fingers on their way around the handle, metres: one of 12 mm fits between handle and front. Chosen."""

OVER = 0.10
"""Height above the handle from which it is approached, metres. Chosen."""

FULLY = 0.85
"""Share of the travel by which a drawer counts as open. Chosen."""


def open_drawer(operator: Operator) -> None:
    """Close the fingers on the bar from above, pull, let go, and look back at the cabinet."""
    world, rng = operator.world, operator.rng
    cabinet = world.world_from_body("cabinet")
    outwards = -cabinet[:3, 1]
    bar = at_handle(world)
    # One finger on either side of the bar; the camera on either side of the gripper.
    yaw = float(np.arctan2(outwards[1], outwards[0])) + float(rng.choice([0.0, np.pi]))
    # The nearer of the two turns there: the hand starts at a yaw of about 0.
    yaw = (yaw + np.pi) % (2 * np.pi) - np.pi
    operator.move(to=pointing_down(raised(bar, OVER), yaw))
    operator.grip(AROUND_BAR)
    operator.move(to=pointing_down(bar, yaw), slow=1.5)
    operator.wait(2)
    operator.grip(0.0)
    pulled = world.dimensions["travel"] - float(world.data.joint("drawer").qpos[0])
    operator.move(to=pointing_down(bar + pulled * outwards, yaw), slow=float(rng.uniform(1.6, 2.2)))
    operator.wait(2)
    operator.grip(AROUND_BAR)
    operator.shift(z=OVER)
    operator.grip(0.08)
    back = bar + 0.02 * outwards
    operator.move(to=pointing_down(np.array([back[0], back[1], 0.34]), float(rng.uniform(-0.3, 0.3))))


def at_handle(world: World) -> Float[ndarray, "3"]:
    """The middle of the handle, metres, world frame."""
    cabinet, size = world.world_from_body("cabinet"), world.dimensions
    out = size["front"] + STANDOFF + float(world.data.joint("drawer").qpos[0])
    return cabinet[:3, :3] @ [0, -out, size["handle"]] + cabinet[:3, 3]


def drawer_is_open(world: World) -> bool:
    """Whether the drawer is out by nearly its travel."""
    return float(world.data.joint("drawer").qpos[0]) > FULLY * world.dimensions["travel"]
