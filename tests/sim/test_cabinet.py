from __future__ import annotations

import numpy as np
import pytest

from bask_data.core.geometry import invert_rigid
from bask_data.sim.cabinet import ALMOST_SHUT, SLACK
from bask_data.sim.world import TOUCHING
from tests.sim.worlds import demonstration_of, views, world_of


def test_drawer_starts_almost_shut_and_at_random() -> None:
    world = world_of("drawer")
    openings = []
    for seed in range(5):
        world.restore(world.lay_out(np.random.default_rng(seed)))
        openings.append(float(world.data.joint("drawer").qpos[0]))
    assert min(openings) >= 0 and max(openings) < ALMOST_SHUT + 1e-4
    assert np.ptp(openings) > 0.003


def test_drawer_runs_inside_the_cabinet_without_touching_it_and_counts_as_touching() -> None:
    world = world_of("drawer")
    world.restore(world.lay_out(np.random.default_rng(0)))
    drawer, cabinet = (np.flatnonzero(world.geom_labels == world.labels[name]) for name in ("drawer", "cabinet"))
    for opening in (0.0, 0.05, world.dimensions["travel"]):
        world.data.joint("drawer").qpos[:] = opening
        world.show(world.data.qpos)
        assert world.distance(drawer, cabinet, 1.0) == pytest.approx(SLACK, abs=1e-4)
    assert SLACK < TOUCHING


def test_true_pose_of_the_drawer_is_the_cabinets_moved_along_its_slide() -> None:
    world, take = world_of("drawer"), demonstration_of("drawer")
    rows = [world.labels[name] - 1 for name in ("cabinet", "drawer")]
    cabinet, drawer = (take.world_from_objects[:, row] for row in rows)
    opening = take.qpos[:, world.address("drawer")]
    cabinet_from_drawer = invert_rigid(cabinet) @ drawer
    np.testing.assert_allclose(
        cabinet_from_drawer[:, :3, :3], np.broadcast_to(np.eye(3), (len(drawer), 3, 3)), atol=1e-9
    )
    np.testing.assert_allclose(cabinet_from_drawer[:, 1, 3], -world.dimensions["front"] - opening, atol=1e-9)
    np.testing.assert_allclose(np.ptp(cabinet_from_drawer[:, [0, 2], 3], axis=0), 0, atol=1e-9)


def test_drawer_and_handle_are_labelled_and_the_inside_shows_only_when_open() -> None:
    world, take = world_of("drawer"), demonstration_of("drawer")
    shut, opened = views(world, take, "overhead", [0, len(take.time) - 1], shows_gripper=False)
    n_shut, n_open = ((view.instance == world.labels["drawer"]).sum() for view in (shut, opened))
    assert 0 < 1.5 * n_shut < n_open
