from __future__ import annotations

import numpy as np
import pytest

from bask_data.core.geometry import invert_rigid, rigid_fault
from bask_data.sim import gripper
from bask_data.sim.options import TASKS, SimOptions, TaskName
from bask_data.sim.scan import camera_path, looking, scan
from bask_data.sim.world import World
from tests.sim.worlds import renderer_of


@pytest.mark.parametrize("task", TASKS)
def test_camera_moves_around_with_varied_distance_height_and_roll_and_sees_the_objects(task: TaskName) -> None:
    world = World(SimOptions(task=task, height=48, width=64, frames=40))
    take = scan(world, np.random.default_rng(1))
    world.restore(take.layout)
    renderer = renderer_of(world)
    renderer.shows_gripper = False
    n_seen, poses = [], []
    for qpos in take.qpos:
        world.show(qpos)
        view = renderer.view("wrist")
        n_seen.append(len(np.unique(view.instance)) - 1)
        poses.append(view.world_from_camera)
    assert min(n_seen) >= 1
    assert np.mean(n_seen) > 0.75 * len(world.labels)
    poses = np.array(poses)
    eyes = poses[:, :3, 3]
    assert eyes[:, 2].min() > 0.1
    middle = take.world_from_objects[0, :, :3, 3].mean(axis=0)
    distance = np.linalg.norm(eyes - middle, axis=1)
    assert distance.min() > 0.25
    assert distance.max() / distance.min() > 1.2
    azimuth = np.unwrap(np.arctan2(*(eyes - middle)[:, 1::-1].T))
    assert abs(azimuth[-1] - azimuth[0]) > 2 * np.pi
    elevation = np.degrees(np.arcsin((eyes - middle)[:, 2] / distance))
    assert elevation.min() < 40 and elevation.max() > 65
    level = np.degrees(np.arcsin(poses[:, 2, 0]))
    assert np.ptp(level) > 15


@pytest.mark.parametrize("task", TASKS)
def test_distances_have_the_requested_spread_and_the_camera_stays_outside_objects(task: TaskName) -> None:
    ratios = []
    for spread in (0.22, 0.6):
        world = World(SimOptions(task=task, height=48, width=64, frames=60, distance_spread=spread))
        take = scan(world, np.random.default_rng(1))
        world.restore(take.layout)
        centres = world.data.geom_xpos[world.is_object_geom()]
        middle = (centres.min(axis=0) + centres.max(axis=0)) / 2
        eyes = camera_path(world, 60, np.random.default_rng(2))[:, :3, 3]
        distance = np.linalg.norm(eyes - middle, axis=1)
        ratios.append(distance.max() / distance.min())
        renderer = renderer_of(world)
        renderer.shows_gripper = False
        for qpos in take.qpos[::6]:
            world.show(qpos)
            depth = renderer.view("wrist").depth
            assert depth[depth > 0].min() > 0.05
    assert ratios[1] > 1.5 * ratios[0]
    assert ratios[1] < 1.6 / 0.4 + 1e-6


def test_wrist_camera_follows_the_path() -> None:
    world = World(SimOptions(task="lid", height=48, width=64, frames=7))
    take = scan(world, np.random.default_rng(0))
    world.restore(take.layout)
    path = camera_path(world, 7, np.random.default_rng(0))
    assert path.shape == (7, 4, 4)
    hand_from_camera = gripper.gripper_from_camera()
    for qpos in take.qpos:
        world.show(qpos)
        expected = world.world_from_body("hand") @ hand_from_camera
        np.testing.assert_allclose(renderer_of(world).world_from_camera("wrist"), expected, atol=1e-6)


def test_only_the_gripper_moves() -> None:
    world = World(SimOptions(task="rubbish", height=48, width=64, frames=5))
    take = scan(world, np.random.default_rng(0))
    assert (take.world_from_objects == take.world_from_objects[0]).all()
    moving = np.flatnonzero(np.ptp(take.qpos, axis=0) > 0)
    own = [world.address("hand") + i for i in range(7)] + [world.address("left"), world.address("right")]
    assert set(moving) <= set(own)
    assert np.ptp(take.qpos[:, world.address("left")]) > 0.01


def test_a_camera_looks_at_its_target() -> None:
    eye, at = np.array([0.3, -0.4, 0.5]), np.array([0.1, 0.1, 0.0])
    for roll in (0.0, 0.7):
        world_from_camera = looking(eye, at, roll)
        assert rigid_fault(world_from_camera) == ""
        seen = invert_rigid(world_from_camera) @ [*at, 1]
        np.testing.assert_allclose(seen[:2], 0, atol=1e-12)
        assert seen[2] > 0
    level = looking(eye, at, 0.0)
    assert level[2, 0] == pytest.approx(0) and level[2, 1] < 0
