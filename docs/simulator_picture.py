"""Draw the picture of the simulator's page: python docs/simulator_picture.py"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from bask_data.drawing.colours import palette
from bask_data.sim.experts import demonstrate
from bask_data.sim.options import TASKS, SimOptions
from bask_data.sim.rendering import RenderedView, Renderer
from bask_data.sim.scan import scan
from bask_data.sim.world import World

HERE = Path(__file__).parent
SIZE, SHOWN = 200, 6
"""Edge of a picture, pixels, and the frame of the scan that is shown: all objects are seen from their front."""

MOMENTS = (0.0, 0.35, 0.6, 1.0)
"""Shares of a demonstration at which it is shown."""


def main() -> None:
    """A row a task: a scan's colour, depth and labels, then a demonstration from above."""
    rows = []
    for task in TASKS:
        world = World(SimOptions(task=task, height=SIZE, width=SIZE, frames=8))
        with Renderer(world) as renderer:
            take = scan(world, np.random.default_rng(1))
            world.restore(take.layout)
            world.show(take.qpos[SHOWN])
            renderer.shows_gripper = False
            tiles = views_of(renderer.view("wrist"), len(world.labels))
            show = demonstrate(world, np.random.default_rng(1))
            assert show is not None
            world.restore(show.layout)
            renderer.shows_gripper = True
            for moment in MOMENTS:
                world.show(show.qpos[round(moment * (len(show.qpos) - 1))])
                tiles.append(renderer.view("overhead").rgb)
        rows.append(np.hstack(tiles))
    picture = np.vstack(rows)
    cv2.imwrite(str(HERE / "simulator.jpg"), picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 88])


def views_of(view: RenderedView, n_labels: int) -> list[np.ndarray]:
    """Colour, depth and labels of a view as pictures."""
    near, far = np.quantile(view.depth[view.depth > 0], (0.01, 0.95))
    grey = np.uint8(255 * (1 - (view.depth.clip(near, far) - near) / (far - near)))
    depth = np.where(view.depth[..., None] > 0, cv2.applyColorMap(grey, cv2.COLORMAP_VIRIDIS)[..., ::-1], 0)
    colours = np.array([(40, 40, 44), *palette(n_labels)], dtype=np.uint8)
    return [view.rgb, depth.astype(np.uint8), colours[view.instance]]


if __name__ == "__main__":
    main()
