"""The expert of the task `mug`: it hangs a mug on a hook by its handle."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from bask_data.core.geometry import invert_rigid
from bask_data.sim.motions import raised
from bask_data.sim.mug import SLOPE
from bask_data.sim.operator import Operator, grasped, nearest_half_turn, pointing_down
from bask_data.sim.world import World

AROUND_WALL = 0.040
"""Opening of the fingers on their way around the mug's wall, metres: one fits inside the mug. Chosen."""

DEPTH = 0.012
"""Depth below the rim at which the wall is grasped, metres. Chosen."""

SEAT = 0.055
"""Distance along the hook at which a mug is hung, metres. Chosen."""


def hang_mug(operator: Operator) -> None:
    """Grasp the mug's wall opposite its handle, tilt the mug as it will hang, and lower its handle onto the hook."""
    world, rng = operator.world, operator.rng
    mug = world.world_from_body("mug")
    wall = mug[:3, 3] - mug[:3, 0] * (world.dimensions["radius"] - 0.0025)
    at = raised(wall, world.dimensions["rim"] - DEPTH)
    yaw = nearest_half_turn(float(np.arctan2(mug[1, 0], mug[0, 0])))
    operator.move(to=pointing_down(raised(at, 0.10), yaw))
    operator.grip(AROUND_WALL)
    operator.move(to=pointing_down(at, yaw), slow=1.5)
    operator.wait(2)
    operator.grip(0.0)
    operator.shift(z=0.13)
    operator.wait(2)
    held = grasped(world, "mug", world.world_from_body("hand"))
    before_hook = world.dimensions["length"] + 0.11
    # The mug may open to either side.
    turned = min((False, True), key=lambda turned: operator.turn_to(held_around(world, before_hook, turned) @ held))
    operator.move(to=held_around(world, before_hook, turned) @ held)
    operator.wait(3)
    # The mug may have moved in the grasp while it was tilted.
    held = grasped(world, "mug", world.world_from_body("hand"))
    operator.move(to=held_around(world, SEAT, turned) @ held, slow=1.5)
    operator.wait(2)
    operator.move(to=hanging(world, SEAT, turned) @ held, slow=3.0)
    operator.wait(3)
    operator.grip(AROUND_WALL)
    away = operator.target.copy()
    away[:3, 3] -= 0.11 * away[:3, 2]
    operator.move(to=away)
    operator.grip(0.08)
    stand = world.world_from_body("stand")[:3, 3]
    home = np.array([stand[0] + rng.uniform(-0.03, 0.03), stand[1] - 0.10, 0.36])
    operator.move(to=pointing_down(home, float(rng.uniform(-0.3, 0.3))))
    operator.wait(6)


def hanging(world: World, along: float, turned: bool) -> Float[ndarray, "4 4"]:
    """world_from_mug of a mug at rest on the hook.

    Args:
        along: metres from the post, along the hook.
        turned: whether the mug opens to the other side.
    """
    size, stand = world.dimensions, world.world_from_body("stand")
    hook = np.array([0, -np.cos(SLOPE), np.sin(SLOPE)])
    up = np.array([0, np.sin(SLOPE), np.cos(SLOPE)])
    across = -hook if turned else hook
    seat = np.array([size["seat_x"], 0, size["seat_z"]])
    # At rest, the centre of mass is straight below the hook.
    rise = seat - world.model.body("mug").ipos * [1, 0, 1]
    rise = rise / np.linalg.norm(rise)
    y = np.array([0.0, 1.0, 0.0])
    mug_axes = np.column_stack([y, rise, np.cross(y, rise)])
    stand_from_mug = np.eye(4)
    stand_from_mug[:3, :3] = np.column_stack([across, up, np.cross(across, up)]) @ mug_axes.T
    stand_from_mug[:3, 3] = np.array([0, 0, size["hook"]]) + along * hook - stand_from_mug[:3, :3] @ seat
    return stand @ stand_from_mug


def held_around(world: World, along: float, turned: bool) -> Float[ndarray, "4 4"]:
    """world_from_mug of a mug turned as when it hangs, with the hook in the middle of its handle."""
    size, world_from_mug = world.dimensions, hanging(world, along, turned)
    world_from_mug[:3, 3] += world_from_mug[:3, :3] @ [
        size["seat_x"] - size["hole_x"],
        0,
        size["seat_z"] - size["hole_z"],
    ]
    return world_from_mug


def mug_hangs(world: World) -> bool:
    """Whether the hook's middle passes through the mug's handle, and the mug is off the table."""
    size = world.dimensions
    hook = np.array([0, -np.cos(SLOPE), np.sin(SLOPE)])
    through = [0, 0, size["hook"]] + hook * SEAT
    mug_from_stand = invert_rigid(world.world_from_body("mug")) @ world.world_from_body("stand")
    at = mug_from_stand[:3, :3] @ through + mug_from_stand[:3, 3]
    seat = np.array([size["seat_x"], size["seat_z"]])
    lowest = float(world.data.geom_xpos[world.geoms_of("mug"), 2].min())
    return bool(np.linalg.norm(at[[0, 2]] - seat) < 0.012 and abs(at[1]) < 0.03 and lowest > 0.03)
