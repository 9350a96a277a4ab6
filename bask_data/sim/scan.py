"""Scanning: the wrist camera moves on a spiral around a static scene."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from bask_data.core.geometry import invert_rigid
from bask_data.sim import gripper
from bask_data.sim.take import Take
from bask_data.sim.world import Layout, World

SCAN_FRAMES_PER_SECOND = 10.0
"""Frame rate of a scan's timestamps. The scene is static, so it only defines the camera's speed."""

ELEVATION = (np.radians(24.0), np.radians(78.0))
"""Range of the camera's elevation above the table, radians. Chosen."""

TURNS = 2.25
"""Revolutions of the camera around the objects. Chosen."""


def scan(world: World, rng: np.random.Generator, layout: Layout | None = None) -> Take:
    """Move the camera around a scene, by default a new one."""
    layout = layout or world.lay_out(rng)
    world.restore(layout)
    world_from_cameras = camera_path(world, world.options.frames, rng)
    hands = world_from_cameras @ invert_rigid(gripper.gripper_from_camera())
    n_frames = len(hands)
    qpos = np.repeat(layout.qpos[None], n_frames, axis=0)
    hand, fingers = world.address("hand"), [world.address("left"), world.address("right")]
    qpos[:, hand : hand + 7] = [free_joint(transform) for transform in hands]
    # The fingers open and close four times, whether or not they are rendered.
    opening = 0.5 + 0.45 * np.cos(2 * np.pi * 4 * np.arange(n_frames) / max(n_frames, 1))
    qpos[:, fingers] = (gripper.MAX_WIDTH / 2 * opening)[:, None]
    return Take(
        layout=layout,
        qpos=qpos,
        time=np.arange(n_frames) / SCAN_FRAMES_PER_SECOND,
        world_from_objects=np.repeat(world.world_from_objects()[None], n_frames, axis=0),
        touching=world.touching(),
        shows_gripper=world.options.gripper_in_view,
    )


def camera_path(world: World, n_frames: int, rng: np.random.Generator) -> Float[ndarray, "t 4 4"]:
    """world_from_camera (t, 4, 4) on a spiral on the upper hemisphere, with varied distance, target and roll."""
    centres = world.data.geom_xpos[world.is_object_geom()]
    middle = (centres.min(axis=0) + centres.max(axis=0)) / 2
    extent = float(np.linalg.norm(centres - middle, axis=1).max())
    distance = np.clip(0.36 + 0.75 * extent, 0.42, 0.62)
    s = np.linspace(0, 1, n_frames)
    sway, lean, aim_x, aim_y = (smooth(s, rng) for _ in range(4))
    azimuth = rng.uniform(0, 2 * np.pi) + 2 * np.pi * TURNS * s
    # Up and down again, so that revolutions cross and differ in height.
    elevation = ELEVATION[0] + (ELEVATION[1] - ELEVATION[0]) * (0.5 - 0.5 * np.cos(2 * np.pi * s))
    radius = distance * (1 + world.options.distance_spread * sway)
    ring = radius * np.cos(elevation)
    eyes = middle + np.stack([ring * np.cos(azimuth), ring * np.sin(azimuth), radius * np.sin(elevation)], axis=1)
    aims = middle + 0.05 * np.stack([aim_x, aim_y, np.zeros(n_frames)], axis=1)
    return np.stack(
        [looking(eye, aim, roll) for eye, aim, roll in zip(eyes, aims, np.radians(35.0) * lean, strict=True)]
    )


def smooth(s: Float[ndarray, " t"], rng: np.random.Generator) -> Float[ndarray, " t"]:
    """Random smooth wave in [-1, 1] for s in [0, 1]."""
    waves = [np.sin(2 * np.pi * (n * s + rng.uniform())) for n in (1, 2, 3.5)]
    return np.dot([0.5, 0.3, 0.2], waves)


def looking(eye: Float[ndarray, "3"], at: Float[ndarray, "3"], roll: float) -> Float[ndarray, "4 4"]:
    """world_from_camera at `eye` looking at `at`, metres, rotated about its axis by `roll`, radians."""
    forward = (at - eye) / np.linalg.norm(at - eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right = right / np.linalg.norm(right)
    down = np.cross(forward, right)
    transform = np.eye(4)
    transform[:3, 0] = np.cos(roll) * right + np.sin(roll) * down
    transform[:3, 1] = np.cos(roll) * down - np.sin(roll) * right
    transform[:3, 2], transform[:3, 3] = forward, eye
    return transform


def free_joint(transform: Float[ndarray, "4 4"]) -> Float[ndarray, "7"]:
    """Position and quaternion (w x y z) of MuJoCo's free joint."""
    return np.concatenate([transform[:3, 3], quat_wxyz(transform[:3, :3])])


def quat_wxyz(rotation: Float[ndarray, "3 3"]) -> Float[ndarray, "4"]:
    """The unit quaternion of a rotation."""
    from bask_data.sim.engine import import_mujoco

    quat = np.zeros(4)
    import_mujoco().mju_mat2Quat(quat, np.ascontiguousarray(rotation).reshape(-1))
    return quat
