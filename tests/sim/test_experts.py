from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from bask_data.core.geometry import invert_rigid, rotation_angle
from bask_data.sim import experts
from bask_data.sim.experts import EXPERTS, demonstrate
from bask_data.sim.operator import ACTION_NAMES, CONTROL_RATE, nearest_half_turn, pointing_down
from bask_data.sim.options import TASKS, SimOptions, TaskName
from bask_data.sim.world import World
from tests.sim.worlds import demonstration_of, world_of


def end_of(task: TaskName, seed: int = 0) -> World:
    """The world after a demonstration."""
    world, take = world_of(task, seed), demonstration_of(task, seed)
    world.restore(take.layout)
    world.show(take.qpos[-1])
    return world


def test_microwave_is_shut() -> None:
    take = demonstration_of("microwave")
    assert take.qpos[0, world_of("microwave").address("door")] < -0.8
    assert abs(end_of("microwave").data.joint("door").qpos[0]) < np.radians(3)


def test_lid_lies_on_the_table_beside_the_pan() -> None:
    world = end_of("lid")
    lid, pan = world.world_from_body("lid"), world.world_from_body("saucepan")
    assert lid[2, 3] == pytest.approx(0, abs=0.002)
    assert world.distance(world.geoms_of("lid"), world.geoms_of("saucepan"), 1.0) > 0.005
    assert np.degrees(np.arccos(min(1, lid[2, 2]))) < 2
    assert pan[2, 3] == 0


def test_phone_lies_in_its_cradle() -> None:
    world = end_of("phone")
    base_from_phone = invert_rigid(world.world_from_body("base")) @ world.world_from_body("phone")
    assert np.abs(base_from_phone[:2, 3]).max() < 0.012
    assert base_from_phone[2, 3] == pytest.approx(world.dimensions["top"], abs=0.004)
    assert world.touching() == [(1, 2)]


def test_rubbish_is_in_the_bin_and_other_objects_stay() -> None:
    world, take = end_of("rubbish"), demonstration_of("rubbish")
    corners = world.data.geom_xpos[world.geoms_of("rubbish")]
    inside = (corners - world.world_from_body("bin")[:3, 3]) @ world.world_from_body("bin")[:3, :3]
    assert (np.abs(inside[:, :2]) < world.dimensions["half"]).all()
    assert (inside[:, 2] < world.dimensions["height"]).all()
    for name in ("tomato", "can", "bin"):
        row = world.labels[name] - 1
        moved = take.world_from_objects[-1, row] - take.world_from_objects[0, row]
        assert np.abs(moved[:3, 3]).max() < 0.01


@pytest.mark.parametrize("task", TASKS)
def test_nothing_is_teleported(task: TaskName) -> None:
    take, world = demonstration_of(task), world_of(task)
    steps = np.linalg.norm(np.diff(take.world_from_objects[:, :, :3, 3], axis=0), axis=-1)
    assert steps.max() * CONTROL_RATE < 1.5  # Metres per second: a fall of ten centimetres ends at 1.4.
    assert take.robot is not None
    hand = np.linalg.norm(np.diff(take.robot.world_from_gripper[:, :3, 3], axis=0), axis=-1)
    assert hand.max() * CONTROL_RATE < 0.8
    # Nothing moves before the gripper is near it.
    row = world.labels[EXPERTS[task].moves] - 1
    moves = np.flatnonzero(np.linalg.norm(np.diff(take.world_from_objects[:, row, :3, :], axis=0), axis=(1, 2)) > 0.002)
    geoms = np.flatnonzero(world.geom_labels == row + 1)
    for i_frame in moves[:3]:
        world.restore(take.layout)
        world.show(take.qpos[i_frame])
        fingers = np.flatnonzero(world.geom_labels == 255)
        assert world.distance(geoms, fingers, 1.0) < 0.02


@pytest.mark.parametrize("task", TASKS)
def test_actions_add_up_to_the_grippers_motion(task: TaskName) -> None:
    robot = demonstration_of(task).robot
    assert robot is not None
    assert robot.action_names == ACTION_NAMES
    assert robot.action.shape == (len(robot.world_from_gripper), len(ACTION_NAMES))
    target = robot.world_from_gripper[0]
    lag = []
    for action, reached in zip(robot.action[:-1], robot.world_from_gripper[1:], strict=True):
        target = target.copy()
        target[:3, 3] += action[:3]
        target[:3, :3] = cv2.Rodrigues(action[3:6])[0] @ target[:3, :3]
        lag.append(np.linalg.norm(target[:3, 3] - reached[:3, 3]))
    assert np.median(lag) < 0.01 and max(lag) < 0.03
    assert lag[-1] < 0.003
    assert rotation_angle(target[:3, :3].T @ robot.world_from_gripper[-1, :3, :3]) < 0.02
    assert (robot.action[-1, :6] == 0).all()
    assert robot.gripper_width.min() >= 0 and robot.gripper_width.max() < 0.085


def test_grasped_objects_keep_the_fingers_apart() -> None:
    for task, width in (("phone", 0.034), ("lid", 0.034)):
        robot = demonstration_of(task).robot  # type: ignore[arg-type]
        assert robot is not None
        closed = robot.gripper_width[robot.action[:, -1] == 0]
        assert np.median(closed) == pytest.approx(width, abs=0.003)


def test_same_seed_gives_the_same_demonstration() -> None:
    takes = [demonstrate(World(SimOptions(task="lid", seed=2)), np.random.default_rng(4)) for _ in range(2)]
    assert takes[0] is not None and takes[1] is not None
    np.testing.assert_array_equal(takes[0].qpos, takes[1].qpos)


@pytest.mark.parametrize("task", TASKS)
def test_doing_nothing_is_a_failure(task: TaskName, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(EXPERTS, task, replace(EXPERTS[task], work=lambda operator: operator.wait(1)))
    assert demonstrate(world_of(task), np.random.default_rng(0)) is None


def test_moving_an_object_outside_the_task_is_a_failure() -> None:
    world = end_of("rubbish")
    before = world.world_from_objects()
    assert experts._others_are_left_alone(world, before)
    can = before.copy()
    can[world.labels["can"] - 1, 0, 3] += 0.02
    assert not experts._others_are_left_alone(world, can)
    paper = before.copy()
    paper[world.labels["rubbish"] - 1, 0, 3] += 0.2
    assert experts._others_are_left_alone(world, paper)


@pytest.mark.parametrize("yaw", [-3.0, -1.6, -0.2, 1.5, 1.7, 3.1])
def test_nearest_half_turn_keeps_the_line_of_fingers_and_stays_close(yaw: float) -> None:
    near = nearest_half_turn(yaw)
    assert abs(near) <= np.pi / 2 + 1e-9
    assert abs(np.sin(near - yaw)) < 1e-9
    down = pointing_down(np.array([0.1, 0.2, 0.3]), near)
    np.testing.assert_allclose(down[:3, 2], [0, 0, -1])
    assert np.linalg.det(down[:3, :3]) == pytest.approx(1)


@pytest.mark.slow
@pytest.mark.parametrize("task", TASKS)
def test_experts_succeed_in_nine_of_ten_attempts(task: TaskName) -> None:
    done = [
        demonstrate(World(SimOptions(task=task, seed=seed)), np.random.default_rng([seed, 1])) is not None
        for seed in range(24)
    ]
    print(f"{task}: {sum(done)} of {len(done)}")
    assert np.mean(done) >= 0.9


@pytest.mark.slow
@pytest.mark.parametrize("task", ["drawer", "mug"])
def test_experts_of_held_out_tasks_succeed_in_95_of_100_attempts(task: TaskName) -> None:
    done = [
        demonstrate(World(SimOptions(task=task, seed=seed)), np.random.default_rng([seed, 1])) is not None
        for seed in range(100)
    ]
    print(f"{task}: {sum(done)} of {len(done)}")
    assert np.mean(done) >= 0.95
