from __future__ import annotations

import pytest

from bask_data.core.visibility.surface import Surface
from tests import meshes
from tests.blocks import BLOCKS, CAMERAS, HEIGHT, SCENE, WIDTH, K


@pytest.fixture(scope="module")
def surface():
    vertices, triangles, _ = meshes.table(BLOCKS, step=0.01)
    return Surface(vertices, triangles)


@pytest.fixture(scope="module")
def images():
    return [SCENE.render(K, camera, HEIGHT, WIDTH) for camera in CAMERAS]
