"""What each scan shows of its objects: the evidence of their identity, and a picture of each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from bask_data.kinds import ObjectInstances, Reconstruction, Scan, VisibleMasks

if TYPE_CHECKING:
    import numpy as np

    from bask_data.core.identity import ObjectLook
    from bask_data.nn.appearance import Appearance

FRAMES_READ = 24
"""Frames of a scan that are read, evenly over all cameras. Chosen, sensitivity not measured."""
LEAST_MASK = 30
"""Pixels of a mask below which a frame says nothing of an object. Chosen, sensitivity not measured."""
LEAST_SHARE = 0.4
"""Size of an object's mask as a share of its largest in any frame read, below which the frame is left out: the object
is mostly hidden or far away. Chosen, sensitivity not measured."""
VIEWS = 8
"""Most views of an object, evenly over its frames. Chosen, sensitivity not measured."""
EROSION = 2
"""Pixels of a crop left out along the edge of the mask, whose colours are mixed with the background's. Chosen."""


@dataclass(frozen=True)
class SeenObject:
    """An object of one scan.

    Args:
        crop: a picture of it (s, s, 3) uint8.
    """

    scene: str
    instance: int
    look: ObjectLook
    crop: np.ndarray

    @property
    def place(self) -> str:
        """SCENE/ID."""
        return f"{self.scene}/{self.instance}"


def seen_objects(
    scan: Scan,
    reconstruction: Reconstruction,
    objects: ObjectInstances,
    masks: VisibleMasks,
    appearance: Appearance,
) -> list[SeenObject]:
    """The objects of a scan that some frame read shows, in the order of their ids."""
    from bask_data.core.identity import ObjectLook, oriented_extents
    from bask_data.core.objects import vertex_normals_and_areas

    areas = vertex_normals_and_areas(reconstruction.vertices, reconstruction.triangles)[1]
    seen = []
    for row, views in zip(objects.instances, _views(scan, objects, masks), strict=True):
        own = objects.vertex_instance == row.id
        if not views or not areas[own].any():
            continue
        extents = oriented_extents(reconstruction.vertices[own].astype("float64"), areas[own])
        look = ObjectLook(extents, colours_of(views), appearance(views))
        # In the middle of the path, not at its ends: recordings begin and end far away or at an angle.
        crop = views[len(views) // 2][0]
        seen.append(SeenObject(scan.path.name, row.id, look, crop))
    return seen


def colours_of(views: Sequence[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """A histogram of the colours of each view (v, b), without the edge of the mask."""
    import cv2
    import numpy as np

    from bask_data.core.identity_colour import colour_histogram

    rows = []
    for crop, mask in views:
        inner = cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8), iterations=EROSION) > 0
        rows.append(colour_histogram(crop[inner if inner.sum() >= LEAST_MASK else mask]))
    return np.stack(rows)


def _views(scan: Scan, objects: ObjectInstances, masks: VisibleMasks) -> list[list[tuple[np.ndarray, np.ndarray]]]:
    """Crops with their masks of each object, in the order of the frames."""
    import numpy as np

    from bask_data.nn.appearance import squared

    cameras = {camera.name: camera for camera in scan.cameras}
    frames = [(name, i) for name, camera in cameras.items() for i in range(camera.n_frames)]
    chosen = np.unique(np.linspace(0, len(frames) - 1, FRAMES_READ).round().astype(int))
    crops: dict[int, list[tuple[int, np.ndarray, np.ndarray]]] = {row.id: [] for row in objects.instances}
    for name, i_frame in (frames[i] for i in chosen):
        rgb, instance = cameras[name].rgb(i_frame), masks.camera(name).instance(i_frame)
        sizes = np.bincount(instance.ravel(), minlength=256)
        for row in objects.instances:
            if sizes[row.id] >= LEAST_MASK:
                crops[row.id].append((int(sizes[row.id]), *squared(rgb, instance == row.id)))
    return [_largest(crops[row.id]) for row in objects.instances]


def _largest(crops: list[tuple[int, np.ndarray, np.ndarray]]) -> list[tuple[np.ndarray, np.ndarray]]:
    """Some of the crops whose object is large enough, evenly over them."""
    import numpy as np

    most = max((size for size, _, _ in crops), default=0)
    large = [(crop, mask) for size, crop, mask in crops if size >= LEAST_SHARE * most]
    if not large:
        return []
    return [large[i] for i in np.unique(np.linspace(0, len(large) - 1, VIEWS).round().astype(int))]
