from __future__ import annotations

import numpy as np

from bask_data.sim.motions import free_spot
from tests.sim.worlds import world_of


def test_free_spot_is_free() -> None:
    world = world_of("lid", clutter=3)
    for seed in range(4):
        world.restore(world.lay_out(np.random.default_rng(seed)))
        spot = free_spot(world, "lid", 0.09, np.random.default_rng(seed))
        for name in ("saucepan", "clutter1", "clutter2", "clutter3"):
            assert np.linalg.norm(spot - world.data.geom_xpos[world.geoms_of(name), :2], axis=1).min() > 0.09
