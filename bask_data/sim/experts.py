"""Scripted experts and success checks of the tasks. Experts know all poses, and grasp by friction."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from bask_data.core.geometry import invert_rigid
from bask_data.sim.hanging import hang_mug, mug_hangs
from bask_data.sim.motions import Expert, free_spot, pick, place, raised, release
from bask_data.sim.operator import Operator, grasped, nearest_half_turn, pointing_down
from bask_data.sim.options import TaskName
from bask_data.sim.pulling import drawer_is_open, open_drawer
from bask_data.sim.take import Take
from bask_data.sim.world import TABLE, World

SPEED_AT_REST = 0.02
"""Metres and radians per second below which objects count as at rest after a task. Chosen."""


def demonstrate(world: World, rng: np.random.Generator) -> Take | None:
    """A demonstration of the world's task in a new scene; None if it failed."""
    expert = EXPERTS[world.options.task]
    layout = world.lay_out(rng)
    world.restore(layout)
    touching = world.touching()
    home = np.array([*rng.uniform(-0.06, 0.06, 2), rng.uniform(0.27, 0.33)]) - [0, 0.06, 0]
    operator = Operator(world, pointing_down(home, rng.uniform(-0.3, 0.3)), rng)
    before = world.world_from_objects()
    operator.wait(3)
    expert.work(operator)
    operator.wait(6)
    take = operator.take(layout, touching)
    return take if expert.is_done(world) and _others_are_left_alone(world, before) and _is_at_rest(world) else None


# Close the microwave --------------------------------------------------------------------------------------------------


def close_microwave(operator: Operator) -> None:
    """Push the door shut with closed fingers, along the arc of a point at three quarters of its width."""
    world, size = operator.world, operator.world.dimensions
    angle = float(world.data.joint("door").qpos[0])
    height = 0.62 * size["height"]
    operator.grip(0.002)
    operator.move(to=_at_door(world, angle, 0.075, 0.26))
    operator.move(to=_at_door(world, angle, 0.075, height))
    operator.move(to=_at_door(world, angle, 0.012, height))
    n_steps = round(abs(angle) * operator.rng.uniform(20, 26))
    for turned in np.linspace(angle, 0.03, n_steps):
        operator.step(_at_door(world, float(turned), 0.008, height), operator.width)
    operator.wait(3)
    operator.move(to=_at_door(world, 0.0, 0.08, height))
    operator.move(to=_at_door(world, 0.0, 0.10, 0.28))


def _at_door(world: World, angle: float, off: float, height: float) -> Float[ndarray, "4 4"]:
    """world_from_gripper outside the door, with the flat sides of the fingers along it.

    Args:
        angle: angle of the door, radians; 0 is shut, negative open.
        off: metres between the door's outer face and the centre between the fingers.
        height: metres above the table.
    """
    size = world.dimensions
    body = world.world_from_body("microwave")
    hinge = np.array([-size["width"] / 2, -size["depth"] / 2, 0])
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    at = body[:3, :3] @ (hinge + turn @ [0.72 * size["door_width"], -size["door"] - off, 0]) + body[:3, 3]
    along = body[:3, :3] @ turn @ [-1.0, 0.0, 0.0]
    return pointing_down(np.array([at[0], at[1], height]), float(np.arctan2(along[1], along[0])))


def microwave_is_closed(world: World) -> bool:
    """Whether the door is open by less than three degrees."""
    return abs(float(world.data.joint("door").qpos[0])) < float(np.radians(3))


# Take the lid off -----------------------------------------------------------------------------------------------------


def take_lid_off(operator: Operator) -> None:
    """Lift the lid by its knob and put it down beside the pan."""
    world = operator.world
    lid = world.world_from_body("lid")[:3, 3]
    grasp = raised(lid, world.dimensions["knob"])
    yaw = float(operator.rng.uniform(-0.6, 0.6))
    spot = free_spot(world, "lid", world.dimensions["radius"] + 0.004, operator.rng)
    pick(operator, grasp, yaw)
    operator.shift(z=0.10)
    place(operator, np.array([*spot, world.dimensions["knob"] + 0.001]), yaw)


def lid_is_off(world: World) -> bool:
    """Whether the lid lies flat on the table beside the pan."""
    lid, pan = world.world_from_body("lid"), world.world_from_body("saucepan")
    apart = float(np.linalg.norm(lid[:2, 3] - pan[:2, 3]))
    return bool(apart > 2 * world.dimensions["radius"] and abs(lid[2, 3]) < 0.004 and lid[2, 2] > np.cos(np.radians(4)))


# Put the phone on its base --------------------------------------------------------------------------------------------


def put_phone_on_base(operator: Operator) -> None:
    """Grasp the handset by its bar, align it with the base, and put it down into the cradle."""
    world, size = operator.world, operator.world.dimensions
    phone, base = world.world_from_body("phone"), world.world_from_body("base")
    bar = raised(phone[:3, 3], size["bar"])
    yaw = nearest_half_turn(float(np.arctan2(phone[1, 0], phone[0, 0])))
    pick(operator, bar, yaw)
    operator.shift(z=0.14)
    # The handset may have moved in the grasp, so its pose is looked up; either of its two orientations will do.
    held = grasped(world, "phone", world.world_from_body("hand"))
    wanted = base.copy()
    wanted[:3, 3] += [0, 0, size["top"] + 0.001]
    turned = wanted @ np.diag([-1.0, -1.0, 1.0, 1.0])
    down = max((wanted @ held, turned @ held), key=lambda to: float(np.trace(to[:3, :3].T @ operator.target[:3, :3])))
    above = down.copy()
    above[2, 3] += 0.10
    operator.move(to=above)
    operator.wait(3)
    operator.move(to=down, slow=2.0)
    operator.wait(3)
    release(operator)


def phone_is_on_base(world: World) -> bool:
    """Whether the handset lies in the cradle."""
    base_from_phone = invert_rigid(world.world_from_body("base")) @ world.world_from_body("phone")
    along = abs(float(base_from_phone[1, 1]))
    return bool(
        np.abs(base_from_phone[:2, 3]).max() < 0.012
        and abs(base_from_phone[2, 3] - world.dimensions["top"]) < 0.004
        and along > np.cos(np.radians(8))
        and base_from_phone[2, 2] > np.cos(np.radians(4))
    )


# Put rubbish in the bin -----------------------------------------------------------------------------------------------


def put_rubbish_in_bin(operator: Operator) -> None:
    """Pick up the crumpled paper, carry it over the bin's edge, and let go."""
    world, size = operator.world, operator.world.dimensions
    paper, container = world.world_from_body("rubbish"), world.world_from_body("bin")
    middle = world.data.geom_xpos[world.geoms_of("rubbish")].mean(axis=0)
    grasp = np.array([middle[0], middle[1], max(0.018, middle[2])])
    yaw = nearest_half_turn(float(np.arctan2(paper[1, 0], paper[0, 0])))
    pick(operator, grasp, yaw)
    operator.shift(z=size["height"] + 0.05)
    over = container[:3, 3] + [*operator.rng.uniform(-0.012, 0.012, 2), size["height"] + 0.06]
    operator.move(to=pointing_down(over, yaw))
    operator.wait(2)
    operator.shift(z=-0.04)
    operator.grip(0.08)
    operator.shift(z=0.10)
    operator.wait(4)


def rubbish_is_in_bin(world: World) -> bool:
    """Whether the paper lies between the bin's walls."""
    bin_from_paper = invert_rigid(world.world_from_body("bin")) @ world.world_from_body("rubbish")
    size = world.dimensions
    return bool(
        np.abs(bin_from_paper[:2, 3]).max() < size["half"] and -0.05 < bin_from_paper[2, 3] < size["height"] - 0.03
    )


def _others_are_left_alone(world: World, before: Float[ndarray, "k 4 4"]) -> bool:
    """Whether the objects that do not belong to the task moved less than 1 cm, and none fell off the table."""
    meant = EXPERTS[world.options.task].moves
    for (name, _), was, now in zip(world.labels.items(), before, world.world_from_objects(), strict=True):
        if name != meant and np.linalg.norm(was[:3, 3] - now[:3, 3]) > 0.01:
            return False
        if np.any(np.abs(now[:2, 3]) > TABLE) or now[2, 3] < -0.05:
            return False
    return True


def _is_at_rest(world: World) -> bool:
    return bool(np.abs(world.data.qvel).max() < SPEED_AT_REST)


EXPERTS: dict[TaskName, Expert] = {
    "microwave": Expert(close_microwave, microwave_is_closed, moves="door"),
    "lid": Expert(take_lid_off, lid_is_off, moves="lid"),
    "phone": Expert(put_phone_on_base, phone_is_on_base, moves="phone"),
    "rubbish": Expert(put_rubbish_in_bin, rubbish_is_in_bin, moves="rubbish"),
    "drawer": Expert(open_drawer, drawer_is_open, moves="drawer"),
    "mug": Expert(hang_mug, mug_hangs, moves="mug"),
}
