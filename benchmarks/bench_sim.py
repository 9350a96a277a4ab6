"""Fifty steps of the simulator, each seen by two cameras, against MuJoCo's own renderer in a loop.

A step is one twentieth of a second of physics, then colour, depth and labels of two 256x256 cameras. Ours renders an
image in two passes where MuJoCo's renderer takes three. Target: fifty steps a second, `ours` below one second.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator

import numpy as np

from bask_data.sim.engine import import_mujoco
from bask_data.sim.operator import N_SUBSTEPS
from bask_data.sim.options import TASKS, SimOptions, TaskName
from bask_data.sim.rendering import Renderer
from bask_data.sim.world import World

N_STEPS = 50
SIZE = 256
CAMERAS = ("wrist", "overhead")
View = Callable[[str], object]


def cases() -> Iterator[tuple[str, Callable[[], object], Callable[[], object]]]:
    """A world for each task, the gripper above its table."""
    # MuJoCo's renderer, unlike ours, needs to be told so before MuJoCo is imported.
    os.environ.setdefault("MUJOCO_GL", "egl")
    for task in TASKS:
        yield f"{task}, {N_STEPS} steps, two cameras", *both(task)


def both(task: TaskName) -> tuple[Callable[[], object], Callable[[], object]]:
    """Ours and the bare loop over the same physics."""
    world = World(SimOptions(task=task, height=SIZE, width=SIZE))
    layout = world.lay_out(np.random.default_rng(0))

    def seen_by(view: View) -> Callable[[], None]:
        def work() -> None:
            world.restore(layout)
            for _ in range(N_STEPS):
                import_mujoco().mj_step(world.model, world.data, nstep=N_SUBSTEPS)
                for camera in CAMERAS:
                    view(camera)

        return work

    return seen_by(Renderer(world).view), seen_by(bare(world))


def bare(world: World) -> View:
    """Colour, depth and labels of a camera by `mujoco.Renderer`."""
    renderer = import_mujoco().Renderer(world.model, SIZE, SIZE)

    def view(camera: str) -> object:
        renderer.update_scene(world.data, camera)
        rgb = renderer.render()
        renderer.enable_depth_rendering()
        depth = renderer.render()
        renderer.enable_segmentation_rendering()
        ids = renderer.render()
        renderer.disable_segmentation_rendering()
        return rgb, depth, ids

    return view
