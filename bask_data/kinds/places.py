"""Where reference keypoints truly are: fixed to the object they were picked on, whose transform truth knows.

Only evaluation, reports and tracks of ground truth may ask.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from bask_data.kinds.cameras import Camera, Recording
from bask_data.kinds.demonstration import Demonstration
from bask_data.kinds.reference import Pick
from bask_data.kinds.truth import ROBOT, Truth

if TYPE_CHECKING:
    import numpy as np

HIDDEN = 0.02
"""Metres: a point is hidden where what the view shows is nearer than it by more than this. Chosen; sensitivity not
measured."""


class Known(NamedTuple):
    """What is known of a recording: frames and cameras, and where its objects are."""

    recording: Recording | None
    truth: Truth | None


@dataclass(frozen=True)
class ObjectPoints:
    """k points that objects carry along.

    Attributes:
        labels: (k,) of each point's object, in the recording it was picked in.
        names: of each point's object; recordings may number their objects differently. Empty: on no object.
        points_object: (k, 3), metres, frame of the object, which all recordings share; NaN where not known.
    """

    labels: tuple[int, ...]
    names: tuple[str, ...]
    points_object: np.ndarray


def true_places(picks: Sequence[Pick], recordings: Mapping[str, Known], name: str) -> np.ndarray:
    """Where keypoints are in each frame of the recording `name` (t, k, 3), metres, world frame; NaN where that is not
    known, or the object is not there.

    Args:
        recordings: by name, this one and those the keypoints were picked in. In its own scan a keypoint is known
            without truth, because nothing moves there.
    """
    import numpy as np

    here = recordings[name]
    assert here.recording is not None, "where its frames are is for the caller to know"
    n_frames = max(camera.n_frames for camera in here.recording.cameras)
    places = np.full((n_frames, len(picks), 3), np.nan)
    if here.truth is not None:
        places = carried(points_on_objects(picks, recordings), here.truth, n_frames)
    if not isinstance(here.recording, Demonstration):
        for i, pick in enumerate(picks):
            point = picked_point(pick, here) if pick.recording == name else None
            if point is not None:
                places[:, i] = point
    return places


def carried(points: ObjectPoints, truth: Truth, n_frames: int) -> np.ndarray:
    """Where the objects of a recording take points (t, k, 3), metres, world frame; NaN where that is not known."""
    import numpy as np

    from bask_data.core.geometry import transform

    places = np.full((n_frames, len(points.names), 3), np.nan)
    poses = object_poses(truth)
    for i, (label, name, point) in enumerate(zip(points.labels, points.names, points.points_object, strict=True)):
        world_from_objects = poses.get(label_of(truth, name, label))
        if world_from_objects is not None:
            # Of what stands still there is one transform for all frames.
            times = np.minimum(np.arange(n_frames), len(world_from_objects) - 1)
            places[:, i] = np.stack([transform(one, point) for one in world_from_objects])[times]
    return places


def points_on_objects(picks: Sequence[Pick], recordings: Mapping[str, Known]) -> ObjectPoints:
    """Keypoints in the frames of the objects they were picked on."""
    import numpy as np

    from bask_data.core.geometry import invert_rigid, transform

    points, labels, names = np.full((len(picks), 3), np.nan), [], []
    poses = {name: object_poses(known.truth) for name, known in recordings.items() if known.truth is not None}
    for i, pick in enumerate(picks):
        known = recordings.get(pick.recording)
        truth = known.truth if known else None
        label = picked_label(pick, truth)
        labels.append(label)
        names.append(truth.label_names.get(label, "") if truth and label not in (0, ROBOT) else "")
        world_from_objects = poses.get(pick.recording, {}).get(label)
        point = picked_point(pick, known)
        if names[-1] and world_from_objects is not None and point is not None:
            points[i] = transform(invert_rigid(world_from_objects[min(pick.frame, len(world_from_objects) - 1)]), point)
    return ObjectPoints(tuple(labels), tuple(names), points)


def picked_label(pick: Pick, truth: Truth | None) -> int:
    """The true label of what a keypoint was picked on: 0 is background, -1 unknown."""
    import numpy as np

    from bask_data.core import scores

    if truth is None or pick.camera not in truth.camera_names:
        return -1
    try:
        labels = truth.instance(pick.camera, pick.frame)
    except IndexError:
        return -1
    return int(scores.label_at(labels, np.array([[pick.u, pick.v]]))[0])


def picked_point(pick: Pick, known: Known | None) -> np.ndarray | None:
    """Where a keypoint was picked (3,), metres, its recording's world: by exact depth and camera where they are known.

    None where there was no depth.
    """
    import numpy as np

    from bask_data.core import scores
    from bask_data.core.geometry import invert_rigid, transform, unproject

    point = None if pick.point_world is None else np.array(pick.point_world, dtype=np.float64)
    truth = known.truth if known else None
    if known is None or truth is None or not truth.has_depth or pick.camera not in truth.camera_names:
        return point
    uv = np.array([[pick.u, pick.v]])
    depth, labels = truth.depth(pick.camera, pick.frame), truth.instance(pick.camera, pick.frame)
    z = scores.true_depth(depth, labels, uv)
    if z[0] <= 0:
        return point
    world_from_camera = truth.world_from_cameras(pick.camera)[pick.frame]
    if known.recording is not None:
        return transform(world_from_camera, unproject(uv, z, known.recording.camera(pick.camera).K))[0]
    if point is None:
        return None
    # Without the intrinsics, along the ray that the picked point is on.
    camera = transform(invert_rigid(world_from_camera), point)
    return transform(world_from_camera, camera * z[0] / camera[2])


def label_of(truth: Truth, name: str, label: int) -> int:
    """The label of the object called `name`: `label` where it is one of those, or else the first; -1 without any."""
    found = [number for number, other in sorted(truth.label_names.items()) if name and other == name]
    return -1 if not found else label if label in found else found[0]


def object_poses(truth: Truth) -> dict[int, np.ndarray]:
    """By label, world from object, metres: (t, 4, 4), or (1, 4, 4) of what stands still."""
    import numpy as np

    still = truth.metadata.world_from_object
    poses = {label: np.array(pose, dtype=np.float64)[None] for label, pose in still.items()}
    moving = truth.world_from_objects
    if moving is not None:
        poses |= {label: moving[:, i] for i, label in enumerate(truth.metadata.object_labels)}
    return poses


class TruePixels(NamedTuple):
    """Where points are in one frame.

    Attributes:
        uv: (k, 2) pixels; NaN where that is not known, or behind the camera.
        inside: (k,) bool: in the image.
        hidden: (k,) bool: in the image, and behind something.
    """

    uv: np.ndarray
    inside: np.ndarray
    hidden: np.ndarray


def true_pixels(points_world: np.ndarray, camera: Camera, truth: Truth | None, i_frame: int) -> TruePixels:
    """Where a camera's frame has points (k, 3), metres, by exact depth and camera where truth knows them."""
    import numpy as np

    from bask_data.core.geometry import in_image, invert_rigid, project, transform

    exact = truth if truth is not None and truth.has_depth and camera.name in truth.camera_names else None
    cameras = exact.world_from_cameras(camera.name) if exact else camera.world_from_cameras
    depth = exact.depth(camera.name, i_frame) if exact else camera.depth(i_frame)
    uv, z = project(transform(invert_rigid(cameras[i_frame]), points_world), camera.K)
    inside = in_image(uv, camera.height, camera.width)
    u, v = np.rint(np.where(inside[:, None], uv, 0)).astype(int).T
    shown = depth[v.clip(0, depth.shape[0] - 1), u.clip(0, depth.shape[1] - 1)]
    return TruePixels(uv, inside, inside & (shown > 0) & (z - shown > HIDDEN))
