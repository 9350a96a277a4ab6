"""Three blocks on a table, and cameras around them."""

from __future__ import annotations

import numpy as np

from bask_data.core.correspondences.matchable import matchable_view
from tests import scenes

HEIGHT, WIDTH = 120, 160

K = scenes.intrinsics(HEIGHT, WIDTH)


def box(x, y, size):
    """The box that `meshes.block` makes, as a body to be ray-cast."""
    world_from_box = np.eye(4)
    world_from_box[:3, 3] = [x + size[0] / 2, y + size[1] / 2, size[2] / 2]
    return scenes.Box(tuple(np.asarray(size) / 2), world_from_box)


BLOCKS = [(-0.12, -0.1, (0.10, 0.06, 0.08)), (0.0, 0.05, (0.07, 0.07, 0.05)), (0.1, -0.12, (0.05, 0.05, 0.12))]

SCENE = scenes.Scene(tuple(box(*one) for one in BLOCKS))

CAMERAS = scenes.orbit(12, radius=0.5)


def views_of(images, surface=None, noise=0.0, missing=0.0, **options):
    rng = np.random.default_rng(0)
    return [
        matchable_view(scenes.noisy(image.depth, noise, rng, missing), image.instance, K, camera, surface, **options)
        for image, camera in zip(images, CAMERAS, strict=True)
    ]
