"""Control of the gripper: targets move smoothly, physics follows, and every control step becomes a frame."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float
from numpy import ndarray

from bask_data.core.geometry import invert_rigid, rotation_angle
from bask_data.sim import gripper
from bask_data.sim.engine import import_mujoco
from bask_data.sim.scan import free_joint, quat_wxyz
from bask_data.sim.take import RobotMotion, Take
from bask_data.sim.world import STEP, Layout, World

CONTROL_RATE = 20.0
"""Frames and commands per second. Chosen."""

N_SUBSTEPS = round(1 / CONTROL_RATE / STEP)
"""Physics steps per frame."""

SPEED, TURN_SPEED = 0.28, 1.6
"""Average speed of a motion, metres and radians per second. Chosen."""

ACTION_NAMES = ("dx", "dy", "dz", "rx", "ry", "rz", "width")
"""Motion of the gripper's target until the next frame, metres and a rotation vector in radians, both along the world
frame's axes; and the commanded width, metres."""


def pointing_down(at: Float[ndarray, "3"], yaw: float) -> Float[ndarray, "4 4"]:
    """world_from_gripper pointing straight down to `at`, metres, with the fingers along `yaw`, radians."""
    cosine, sine = np.cos(yaw), np.sin(yaw)
    transform = np.eye(4)
    transform[:3, :3] = np.array([[cosine, sine, 0], [sine, -cosine, 0], [0, 0, -1]])
    transform[:3, 3] = at
    return transform


def nearest_half_turn(yaw: float, to: float = 0.0) -> float:
    """The yaw closest to `to` with the same line of fingers, which may be swapped; radians."""
    return to + (yaw - to + np.pi / 2) % np.pi - np.pi / 2


class Operator:
    """Control of the gripper in a world, and recording of its motion.

    Args:
        start: initial world_from_gripper.
    """

    def __init__(self, world: World, start: Float[ndarray, "4 4"], rng: np.random.Generator) -> None:
        self.world, self.rng = world, rng
        self.target, self.width = start, gripper.MAX_WIDTH
        self._pace = rng.uniform(0.85, 1.15)
        self._qpos: list[ndarray] = []
        self._objects: list[ndarray] = []
        self._grippers: list[ndarray] = []
        self._widths: list[float] = []
        self._actions: list[ndarray] = []
        hand = world.address("hand")
        world.data.qpos[hand : hand + 7] = free_joint(start)
        self._aim()
        import_mujoco().mj_forward(world.model, world.data)

    def move(self, *, to: Float[ndarray, "4 4"], slow: float = 1.0) -> None:
        """Move the target on a straight line with smooth acceleration, `slow` times as long as usual."""
        begin = self.target
        distance = float(np.linalg.norm(to[:3, 3] - begin[:3, 3]))
        angle = self.turn_to(to)
        seconds = max(distance / SPEED, angle / TURN_SPEED) * slow / self._pace
        turn = cv2.Rodrigues(begin[:3, :3].T @ to[:3, :3])[0]
        n_steps = max(2, round(seconds * CONTROL_RATE))
        for s in np.arange(1, n_steps + 1) / n_steps:
            share = s * s * (3 - 2 * s)
            waypoint = np.eye(4)
            waypoint[:3, :3] = begin[:3, :3] @ cv2.Rodrigues(turn * share)[0]
            waypoint[:3, 3] = (1 - share) * begin[:3, 3] + share * to[:3, 3]
            self.step(waypoint, self.width)

    def turn_to(self, to: Float[ndarray, "4 4"]) -> float:
        """Angle of the rotation from the target to another world_from_gripper, radians."""
        return float(rotation_angle(self.target[:3, :3].T @ to[:3, :3]))

    def shift(self, x: float = 0.0, y: float = 0.0, z: float = 0.0, slow: float = 1.0) -> None:
        """Move along the world's axes, metres."""
        to = self.target.copy()
        to[:3, 3] += [x, y, z]
        self.move(to=to, slow=slow)

    def grip(self, width: float) -> None:
        """Move the fingers to a width, metres, or until they touch an object."""
        for s in (0.25, 0.5, 0.75, 1, 1, 1, 1):
            self.step(self.target, (1 - s) * self.width + s * width, keep=s == 1)
        self.wait(2)

    def wait(self, n_steps: int) -> None:
        """Hold still."""
        for _ in range(n_steps):
            self.step(self.target, self.width)

    def step(self, target: Float[ndarray, "4 4"], width: float, keep: bool = True) -> None:
        """Record a frame, issue one command, and simulate until the next frame.

        Args:
            keep: whether `width` becomes the width of later commands.
        """
        mujoco, data = import_mujoco(), self.world.data
        self._keep_frame(target, width)
        self.target = target
        before, self.width = self.width, width
        self._aim()
        mujoco.mj_step(self.world.model, data, nstep=N_SUBSTEPS)
        if not keep:
            self.width = before

    def take(self, layout: Layout, touching: list[tuple[int, int]]) -> Take:
        """The recorded motion; the last frame's command is to stand still."""
        self._keep_frame(self.target, self.width)
        robot = RobotMotion(np.stack(self._grippers), np.array(self._widths), np.stack(self._actions), ACTION_NAMES)
        return Take(
            layout=layout,
            qpos=np.stack(self._qpos),
            time=np.arange(len(self._qpos)) / CONTROL_RATE,
            world_from_objects=np.stack(self._objects),
            touching=touching,
            shows_gripper=True,
            robot=robot,
        )

    def _aim(self) -> None:
        data = self.world.data
        data.mocap_pos[0], data.mocap_quat[0] = self.target[:3, 3], quat_wxyz(self.target[:3, :3])
        data.ctrl[:] = self.width / 2

    def _keep_frame(self, target: Float[ndarray, "4 4"], width: float) -> None:
        world = self.world
        world.show(world.data.qpos)
        turn = cv2.Rodrigues(target[:3, :3] @ self.target[:3, :3].T)[0][:, 0]
        self._qpos.append(world.data.qpos.copy())
        self._objects.append(world.world_from_objects())
        self._grippers.append(world.world_from_body("hand"))
        self._widths.append(float(world.data.joint("left").qpos[0] + world.data.joint("right").qpos[0]))
        self._actions.append(np.concatenate([target[:3, 3] - self.target[:3, 3], turn, [width]]))


def grasped(world: World, name: str, gripper_target: Float[ndarray, "4 4"]) -> Float[ndarray, "4 4"]:
    """Transform (4, 4) of the gripper in the frame of the grasped object."""
    return invert_rigid(world.world_from_body(name)) @ gripper_target
