from __future__ import annotations

import numpy as np
import pytest

from bask_data.core.geometry import invert_rigid, rotation_angle
from bask_data.sim.experts import demonstrate
from bask_data.sim.hanging import SEAT, hanging, held_around, mug_hangs
from bask_data.sim.options import SimOptions
from bask_data.sim.scan import free_joint
from bask_data.sim.world import World
from tests.sim.worlds import demonstration_of, world_of


def end_of_demonstration() -> World:
    world, take = world_of("mug"), demonstration_of("mug")
    world.restore(take.layout)
    world.show(take.qpos[-1])
    return world


def test_mug_hangs_on_the_hook_by_its_handle_alone() -> None:
    world = end_of_demonstration()
    assert world.touching() == [(world.labels["stand"], world.labels["mug"])]
    assert mug_hangs(world)
    away = np.linalg.norm(world.world_from_body("hand")[:3, 3] - world.world_from_body("mug")[:3, 3])
    assert away > 0.1


def test_mug_comes_to_rest_as_predicted() -> None:
    world = end_of_demonstration()
    resting = world.world_from_body("mug")
    apart = [rotation_angle(resting[:3, :3].T @ hanging(world, SEAT, turned)[:3, :3]) for turned in (False, True)]
    assert np.degrees(min(apart)) < 8


@pytest.mark.parametrize("turned", [False, True])
def test_hanging_puts_the_seat_on_the_hook_and_the_centre_of_mass_below_it(turned: bool) -> None:
    world = world_of("mug")
    size, stand, mug = world.dimensions, world.world_from_body("stand"), hanging(world, SEAT, turned)
    seat = mug[:3, :3] @ [size["seat_x"], 0, size["seat_z"]] + mug[:3, 3]
    in_stand = invert_rigid(stand) @ [*seat, 1]
    assert abs(in_stand[0]) < 1e-9
    assert np.linalg.norm(in_stand[:3] - [0, 0, size["hook"]]) == pytest.approx(SEAT)
    ipos = world.model.body("mug").ipos
    below = invert_rigid(stand)[:3, :3] @ (mug[:3, :3] @ (ipos - [size["seat_x"], 0, size["seat_z"]]))
    assert abs(below[0]) < 1e-9 and below[2] < -0.05


@pytest.mark.parametrize("turned", [False, True])
def test_hook_passes_through_the_handle_without_touching_it(turned: bool) -> None:
    world = world_of("mug")
    world.restore(world.lay_out(np.random.default_rng(0)))
    mug, hook = world.geoms_of("mug"), world.geoms_of("stand")
    address = world.address("mug")
    for along in np.linspace(SEAT, world.dimensions["length"] + 0.11, 12):
        world.data.qpos[address : address + 7] = free_joint(held_around(world, float(along), turned))
        world.show(world.data.qpos)
        assert world.distance(mug, hook, 1.0) > 0.003


def test_a_mug_on_the_table_or_beside_the_hook_does_not_hang() -> None:
    world = world_of("mug")
    world.restore(world.lay_out(np.random.default_rng(0)))
    assert not mug_hangs(world)
    address = world.address("mug")
    for move, hangs in (([0, 0, 0], True), ([0.05, 0, 0], False), ([0, 0, 0.03], False)):
        to = hanging(world, SEAT, False)
        to[:3, 3] += move
        world.data.qpos[address : address + 7] = free_joint(to)
        world.show(world.data.qpos)
        assert mug_hangs(world) is hangs


@pytest.mark.parametrize("seed", range(3))
def test_expert_succeeds_with_other_objects_on_the_table(seed: int) -> None:
    assert demonstrate(World(SimOptions(task="mug", seed=seed, clutter=2)), np.random.default_rng(seed)) is not None
