"""What one depth camera sees of an analytic scene: its surface as triangles between pixels, and the view itself."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bask_data.core.geometry import pixel_grid, transform, unproject
from bask_data.core.objects import Split, SplitSettings, split_objects
from bask_data.core.sightings import PosedDepth
from tests import scenes
from tests.organised_clouds import surface_of

HEIGHT, WIDTH = 180, 240
K = scenes.intrinsics(HEIGHT, WIDTH)
CAMERA = scenes.look_at((0.0, -0.75, 0.45))


@dataclass(frozen=True)
class SingleView:
    """The surface in the world frame, the true instance of each vertex, and the view."""

    vertices: np.ndarray
    triangles: np.ndarray
    truth: np.ndarray
    view: PosedDepth

    def split(self, with_view: bool = True, **options) -> Split:
        """The objects in it."""
        settings = {"voxel_size": 0.004, "views": (self.view,) if with_view else (), **options}
        return split_objects(self.vertices, self.triangles, np.random.default_rng(0), SplitSettings(**settings))


def single_view(scene: scenes.Scene, camera: np.ndarray = CAMERA) -> SingleView:
    """The scene as one camera sees it, without noise."""
    seen = scene.render(K, camera, HEIGHT, WIDTH)
    points = np.where(seen.depth[..., None] > 0, unproject(pixel_grid(HEIGHT, WIDTH), seen.depth, K), np.nan)
    vertices, triangles = surface_of(points.astype(np.float32))
    world = transform(camera, vertices.astype(np.float64)).astype(np.float32)
    return SingleView(world, triangles, seen.instance[seen.depth > 0], PosedDepth(seen.depth, K, camera))


def box(
    x: float, y: float, size: tuple[float, float, float], angle_deg: float = 0.0, bottom: float = 0.0
) -> scenes.Box:
    """A box of a size that stands with its middle at (x, y), turned about the vertical."""
    world_from_box = np.eye(4)
    cosine, sine = np.cos(np.deg2rad(angle_deg)), np.sin(np.deg2rad(angle_deg))
    world_from_box[:2, :2] = [[cosine, -sine], [sine, cosine]]
    world_from_box[:3, 3] = x, y, bottom + size[2] / 2
    return scenes.Box((size[0] / 2, size[1] / 2, size[2] / 2), world_from_box)


TABLE = scenes.Plane(extent=0.45)
TOWER = box(0.0, -0.2, (0.06, 0.06, 0.22))
"""It hides the middle of what stands behind it."""
