"""Keypoints fixed to objects: where they are picked, and the shapes of their objects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from bask_data.dataset import Dataset
from bask_data.evaluation.frames import Frame, Frames
from bask_data.evaluation.true_matches import drawn_pixels

if TYPE_CHECKING:
    import numpy as np

MOST_VIEWS = 20
"""Frames of a scene in which keypoints are looked for, at most, evenly spaced."""
N_SHAPE_POINTS = 2000
"""Points of an object's surface taken from a frame."""


@dataclass(frozen=True)
class PickedPoints:
    """Points fixed to objects, and where they were picked.

    Attributes:
        objects: name of each point's object (k).
        points_object: (k, 3), metres, frame of that object.
        shapes: surface of each of these objects (m, 3), metres, in its frame, as the training scenes show it.
    """

    scene: str
    frame: Frame
    uv: np.ndarray
    objects: tuple[str, ...]
    points_object: np.ndarray
    shapes: dict[str, np.ndarray]


def picked_points(dataset: Dataset, scenes: Sequence[str], end: float, n: int, seed: int) -> PickedPoints:
    """Random pixels, shared equally among objects, of the first scene's view that shows the most objects.

    Args:
        end: share of each camera's frames, from the first, that are considered.
    """
    import numpy as np

    from bask_data.core.geometry import invert_rigid, transform
    from bask_data.core.local_warp import surface_tangents

    rng, frames = np.random.default_rng([seed, 3]), Frames(dataset, scenes[0])
    frame = max(frames.between(0.0, end, MOST_VIEWS), key=lambda frame: _shown(frames, frame))
    labels, depth, world = frames.labels(frame), frames.depth(frame), frames.world_from_camera(frame)
    uv, label = drawn_pixels(frames, frame, depth > 0, n, rng)
    points = transform(world, surface_tangents(uv, depth, labels, frames.K(frame))[0])
    poses = _world_from_objects(frames)
    return PickedPoints(
        frames.scene,
        frame,
        uv,
        tuple(frames.objects[int(i)] for i in label),
        np.stack([transform(invert_rigid(poses[int(i)]), point) for i, point in zip(label, points, strict=True)]),
        object_shapes(dataset, scenes),
    )


def _shown(frames: Frames, frame: Frame) -> tuple[int, int]:
    """Number of objects that a frame shows, and of their pixels."""
    import numpy as np

    n = np.bincount(frames.labels(frame).ravel(), minlength=256)[list(frames.objects)]
    return int((n > 0).sum()), int(n.sum())


def _world_from_objects(frames: Frames) -> dict[int, np.ndarray]:
    """The transform (4, 4) of each object, by label."""
    import numpy as np

    assert frames.truth is not None
    return {label: np.array(pose) for label, pose in frames.truth.metadata.world_from_object.items()}


def object_shapes(dataset: Dataset, scenes: Sequence[str]) -> dict[str, np.ndarray]:
    """By name, surface points (m, 3) of each object, metres, in its frame, as far as the scenes show it."""
    import numpy as np

    from bask_data.core.geometry import invert_rigid, transform

    parts: dict[str, list[np.ndarray]] = {}
    for scene in scenes:
        frames = Frames(dataset, scene)
        poses = _world_from_objects(frames)
        for frame in frames.between(0.0, 1.0, MOST_VIEWS):
            for label, name in frames.objects.items():
                points = frames.points(frame, label, N_SHAPE_POINTS)
                parts.setdefault(name, []).append(transform(invert_rigid(poses[label]), points))
    return {name: np.concatenate(points) for name, points in parts.items()}
