from __future__ import annotations

import numpy as np

from bask_data.kinds import Robot


def test_a_robot_shows_the_shapes_of_what_was_recorded() -> None:
    robot = Robot(world_from_gripper=np.tile(np.eye(4), (5, 1, 1)), action=np.zeros((5, 7)))
    assert repr(robot) == "Robot(world_from_gripper (5, 4, 4), action (5, 7))"
    assert repr(Robot()) == "Robot(nothing recorded)"
