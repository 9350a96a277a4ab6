"""Ground truth of keypoints in other views, and on other instances of their objects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from bask_data.dataset import Dataset
from bask_data.evaluation.frames import Frame, Frames
from bask_data.evaluation.picked_points import MOST_VIEWS, PickedPoints, object_shapes
from bask_data.evaluation.true_matches import shows
from bask_data.kinds.places import ObjectPoints, carried, label_of

if TYPE_CHECKING:
    import numpy as np

SAME_EXTENTS = 0.004
"""Objects of one name are the same instance if the sides of their boxes differ by at most this, metres: unseen parts
make an object seem smaller by some millimetres."""


@dataclass(frozen=True)
class Place:
    """Ground truth of keypoints in a view.

    Attributes:
        uv: (k, 2); NaN where the object is not in the scene.
        state: (k,) `SEEN`, `HIDDEN` or `OUTSIDE`; `ABSENT` where the object is not in the scene.
    """

    frames: Frames
    frame: Frame
    uv: np.ndarray
    state: np.ndarray


ABSENT, OUTSIDE, HIDDEN, SEEN = range(4)


def places_of(
    keypoints: PickedPoints, dataset: Dataset, scenes: Sequence[str], span: tuple[float, float], is_other: bool
) -> list[Place]:
    """Ground truth of the keypoints in all views of the scenes that have their objects.

    Args:
        is_other: the objects may be other instances, so their shapes are compared.
    """
    wanted = set(keypoints.objects)
    having = [scene for scene in scenes if wanted & set(Frames(dataset, scene).objects.values())]
    points = _on_other_instances(keypoints, object_shapes(dataset, having)) if is_other else keypoints.points_object
    places = []
    for frames in (Frames(dataset, scene) for scene in having):
        assert frames.truth is not None
        labels = tuple(label_of(frames.truth, name, 0) for name in keypoints.objects)
        # Scenes are static: points are where they are in the first frame.
        points_world = carried(ObjectPoints(labels, keypoints.objects, points), frames.truth, 1)[0]
        chosen = frames.between(*span, MOST_VIEWS)
        own = keypoints.frame if frames.scene == keypoints.scene and not is_other else None
        places += [_place(frames, frame, labels, points_world) for frame in chosen if frame != own]
    return places


def _on_other_instances(keypoints: PickedPoints, shapes: dict[str, np.ndarray]) -> np.ndarray:
    """The keypoints (k, 3) on instances of other shapes: at the same share of the box along each axis, moved to the
    nearest surface point. Objects with the same box are the same instance."""
    import numpy as np
    from scipy.spatial import cKDTree

    moved = keypoints.points_object.copy()
    for name in {*keypoints.objects} & {*shapes}:
        mine = np.array([other == name for other in keypoints.objects])
        box, other = (
            np.stack([shape.min(axis=0), shape.max(axis=0)]) for shape in (keypoints.shapes[name], shapes[name])
        )
        if np.abs(box - other).max() > SAME_EXTENTS:
            share = (moved[mine] - box[0]) / (box[1] - box[0])
            _, nearest = cKDTree(shapes[name]).query(other[0] + share * (other[1] - other[0]))
            moved[mine] = shapes[name][nearest]
    return moved


def _place(frames: Frames, frame: Frame, labels: Sequence[int], points_world: np.ndarray) -> Place:
    import numpy as np

    from bask_data.core.geometry import in_image, invert_rigid, project, transform

    own = np.array(labels)
    uv, z = project(transform(invert_rigid(frames.world_from_camera(frame)), points_world), frames.K(frame))
    seen = shows(frames, frame, uv, z, own)
    inside = in_image(uv, *frames.size(frame.camera))
    state = np.where(own < 0, ABSENT, np.where(~inside, OUTSIDE, np.where(seen, SEEN, HIDDEN)))
    return Place(frames, frame, uv, state)
