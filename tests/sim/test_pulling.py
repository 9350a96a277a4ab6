from __future__ import annotations

import numpy as np
import pytest

from bask_data.sim.experts import demonstrate
from bask_data.sim.options import SimOptions
from bask_data.sim.pulling import FULLY, at_handle, drawer_is_open
from bask_data.sim.world import World
from tests.sim.worlds import demonstration_of, world_of


def test_drawer_is_pulled_open_and_the_cabinet_stays() -> None:
    world, take = world_of("drawer"), demonstration_of("drawer")
    opening = take.qpos[:, world.address("drawer")]
    assert opening[-1] > FULLY * world.dimensions["travel"]
    assert np.diff(opening).min() > -0.002
    row = world.labels["cabinet"] - 1
    np.testing.assert_array_equal(take.world_from_objects[0, row], take.world_from_objects[-1, row])


def test_drawer_moves_only_while_the_fingers_are_closed_on_its_bar() -> None:
    world, take = world_of("drawer"), demonstration_of("drawer")
    assert take.robot is not None
    moving = np.flatnonzero(np.diff(take.qpos[:, world.address("drawer")]) > 0.001)
    assert take.robot.gripper_width[moving] == pytest.approx(0.010, abs=0.002)
    for i_frame in moving[:: max(1, len(moving) // 5)]:
        world.restore(take.layout)
        world.show(take.qpos[i_frame])
        assert np.linalg.norm(world.world_from_body("hand")[:3, 3] - at_handle(world)) < 0.012


def test_a_drawer_that_is_half_open_does_not_count_as_open() -> None:
    world = world_of("drawer")
    for share, done in ((0.5, False), (0.95, True)):
        world.data.joint("drawer").qpos[:] = share * world.dimensions["travel"]
        assert drawer_is_open(world) is done


@pytest.mark.parametrize("seed", range(3))
def test_expert_succeeds_with_other_objects_on_the_table(seed: int) -> None:
    assert demonstrate(World(SimOptions(task="drawer", seed=seed, clutter=1)), np.random.default_rng(seed)) is not None
