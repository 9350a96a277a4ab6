"""Small simulated worlds for tests, and their analytic rays and surfaces, independent of the renderer."""

from __future__ import annotations

import atexit
from functools import cache

import mujoco
import numpy as np

from bask_data.core.geometry import invert_rigid, pixel_grid, transform, unproject
from bask_data.sim.experts import demonstrate
from bask_data.sim.options import SimOptions, TaskName
from bask_data.sim.rendering import RenderedView, Renderer
from bask_data.sim.scan import scan
from bask_data.sim.take import Take
from bask_data.sim.world import World

SIZE = {"height": 96, "width": 128}


@cache
def world_of(task: TaskName, seed: int = 0, clutter: int = 0, **options: object) -> World:
    """A world shared by tests; set its state first."""
    return World(SimOptions(task=task, seed=seed, clutter=clutter, frames=6, **{**SIZE, **options}))


@cache
def scan_of(task: TaskName, seed: int = 0, clutter: int = 0) -> Take:
    return scan(world_of(task, seed, clutter), np.random.default_rng(seed))


@cache
def demonstration_of(task: TaskName, seed: int = 0) -> Take:
    take = demonstrate(world_of(task, seed), np.random.default_rng([seed, 1]))
    assert take is not None
    return take


@cache
def renderer_of(world: World) -> Renderer:
    """The renderer of a world, cached: creating one takes longer than a hundred images."""
    renderer = Renderer(world)
    atexit.register(renderer.close)
    return renderer


def views(
    world: World, take: Take, camera: str, frames: list[int], shows_gripper: bool | None = None
) -> list[RenderedView]:
    """Images of a camera at some frames; the world stays at the last one."""
    world.restore(take.layout)
    renderer = renderer_of(world)
    renderer.shows_gripper = take.shows_gripper if shows_gripper is None else shows_gripper
    found = []
    for i_frame in frames:
        world.show(take.qpos[i_frame])
        found.append(renderer.view(camera))
    return found


def intrinsics_of(world: World, camera: str) -> np.ndarray:
    return renderer_of(world).K(camera)


def points_world(view: RenderedView, K: np.ndarray) -> np.ndarray:
    """Point of each pixel, world frame, metres."""
    height, width = view.depth.shape
    return transform(view.world_from_camera, unproject(pixel_grid(height, width), view.depth.astype(np.float64), K))


def first_hit(world: World, eye: np.ndarray, direction: np.ndarray) -> tuple[int, float]:
    """Geom (-1: none) and ray parameter of the first hit by MuJoCo's ray caster, independent of the renderer."""
    geom = np.full((1, 1), -1, dtype=np.int32)
    parameter = mujoco.mj_ray(world.model, world.data, eye, direction, None, 1, -1, geom)
    return int(geom[0, 0]), float(parameter)


def distance_to_surface(world: World, geom: int, points: np.ndarray) -> np.ndarray:
    """Distance, metres, of world points (n, 3) from a box, a cylinder or (approximately) an ellipsoid."""
    data, model = world.data, world.model
    world_from_geom = np.eye(4)
    world_from_geom[:3, :3] = data.geom_xmat[geom].reshape(3, 3)
    world_from_geom[:3, 3] = data.geom_xpos[geom]
    local, size = transform(invert_rigid(world_from_geom), points), model.geom_size[geom]
    kind = model.geom_type[geom]
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        beyond = np.abs(local) - size
    elif kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        beyond = np.stack([np.hypot(local[:, 0], local[:, 1]) - size[0], np.abs(local[:, 2]) - size[1]], axis=1)
    else:
        level = np.linalg.norm(local / size, axis=1)
        slope = np.linalg.norm(local / size**2, axis=1)
        return np.abs(level * (level - 1) / slope)
    outside = np.linalg.norm(np.maximum(beyond, 0), axis=1)
    return np.abs(outside + np.minimum(beyond.max(axis=1), 0))
