from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from bask_data.sim import textures
from bask_data.sim.mug import N_WALLS, PEG, wrapped
from tests.sim.worlds import first_hit, world_of


def test_mug_is_hollow_and_its_handle_has_a_hole_wide_enough_for_the_hook() -> None:
    world = world_of("mug")
    world.restore(world.lay_out(np.random.default_rng(0)))
    mug, size = world.world_from_body("mug"), world.dimensions
    above = mug[:3, 3] + [0, 0, 0.3]
    _, to_bottom = first_hit(world, above, np.array([0.0, 0.0, -1.0]))
    assert above[2] - to_bottom == pytest.approx(0.006, abs=0.001)
    _, to_rim = first_hit(world, above + mug[:3, 0] * (size["radius"] - 0.0025), np.array([0.0, 0.0, -1.0]))
    assert above[2] - to_rim == pytest.approx(size["rim"], abs=0.001)
    # A thread through the hole of the handle, along the mug's y axis, hits nothing up to 2 radii of the hook away.
    for x, z in ((0, 0), (2 * PEG, 0), (-2 * PEG, 0), (0, 2 * PEG), (0, -2 * PEG)):
        start = mug[:3, :3] @ [size["hole_x"] + x, -0.03, size["hole_z"] + z] + mug[:3, 3]
        _, to_hit = first_hit(world, start, mug[:3, 1])
        assert to_hit < 0 or to_hit > 0.05


def test_print_runs_around_the_mug_without_seams_between_its_walls() -> None:
    rng = np.random.default_rng(0)
    handle, *walls = wrapped(rng, (0.55, 0.65, 0.9), N_WALLS + 1)
    assert handle.shape == (6, textures.FACE, textures.FACE, 3) and len(walls) == N_WALLS
    # Rows of a wall's outer face run against y: the last one of a wall is next to the first one of the wall before.
    steps = [np.abs(wall[0][0].astype(float) - after[0][-1]).mean() for wall, after in pairwise(walls)]
    apart = [np.abs(wall[0][0].astype(float) - walls[(i + 7) % N_WALLS][0][-1]).mean() for i, wall in enumerate(walls)]
    # Two of the seams are those between the three faces of the print.
    assert sorted(steps)[-3] < 0.5 * np.median(apart)


def test_mug_stands_in_front_of_the_stand_before_the_task() -> None:
    world = world_of("mug")
    for seed in range(4):
        world.restore(world.lay_out(np.random.default_rng(seed)))
        assert world.world_from_body("mug")[1, 3] < world.world_from_body("stand")[1, 3]
        assert world.world_from_body("mug")[2, 2] == pytest.approx(1, abs=1e-4)
