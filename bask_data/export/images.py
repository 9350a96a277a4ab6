"""Colour images of demonstrations, read for export."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from bask_data.kinds import Camera
from bask_data.progress import progress

if TYPE_CHECKING:
    import numpy as np


def frames(camera: Camera, demonstration: str) -> Iterator[np.ndarray]:
    """Iterate over a camera's colour images (h, w, 3) in order, one in memory at a time."""
    for i_frame in progress(range(camera.n_frames), f"exporting {camera.name} of {demonstration}"):
        yield camera.rgb(i_frame)


def blocks(camera: Camera, demonstration: str, n: int) -> Iterator[np.ndarray]:
    """Iterate over blocks of up to `n` colour images (n, h, w, 3)."""
    import numpy as np

    images: list[np.ndarray] = []
    for image in frames(camera, demonstration):
        images.append(image)
        if len(images) == n:
            yield np.stack(images)
            images = []
    if images:
        yield np.stack(images)
