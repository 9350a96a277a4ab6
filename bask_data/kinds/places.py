"""Ground-truth positions of reference keypoints: fixed to the object they were picked on, by its ground-truth pose.

For evaluation, reports and tracks of ground truth only.
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
"""Metres by which a surface must be in front of a point to occlude it. Chosen; sensitivity not measured."""


class Known(NamedTuple):
    """A recording and its ground truth, if available."""

    recording: Recording | None
    truth: Truth | None


@dataclass(frozen=True)
class ObjectPoints:
    """k points fixed to objects.

    Args:
        labels: label of each point's object in the recording of its pick.
        names: name of each point's object, as labels may differ between recordings; empty: not on an object.
        points_object: (k, 3), metres, frame of the object, which all recordings share; NaN: unknown.
    """

    labels: tuple[int, ...]
    names: tuple[str, ...]
    points_object: np.ndarray


def true_places(picks: Sequence[Pick], recordings: Mapping[str, Known], name: str) -> np.ndarray:
    """Ground-truth positions (t, k, 3) of keypoints in the recording `name`, metres, world frame.

    NaN where unknown, or where the recording lacks the object. In the scan it was picked in, a keypoint needs no
    ground truth, as the scene is static.

    Args:
        recordings: by name, this recording and those of the picks.
    """
    import numpy as np

    known = recordings[name]
    assert known.recording is not None, "the recording itself must be given"
    n_frames = max(camera.n_frames for camera in known.recording.cameras)
    places = np.full((n_frames, len(picks), 3), np.nan)
    if known.truth is not None:
        places = carried(points_on_objects(picks, recordings), known.truth, n_frames)
    if not isinstance(known.recording, Demonstration):
        for i, pick in enumerate(picks):
            point = picked_point(pick, known) if pick.recording == name else None
            if point is not None:
                places[:, i] = point
    return places


def carried(points: ObjectPoints, truth: Truth, n_frames: int) -> np.ndarray:
    """Positions (t, k, 3) of points fixed to objects of a recording, metres, world frame; NaN where unknown."""
    import numpy as np

    from bask_data.core.geometry import transform

    places = np.full((n_frames, len(points.names), 3), np.nan)
    poses = object_poses(truth)
    for i, (label, name, point) in enumerate(zip(points.labels, points.names, points.points_object, strict=True)):
        world_from_objects = poses.get(label_of(truth, name, label))
        if world_from_objects is not None:
            # Static objects have a single transform for all frames.
            times = np.minimum(np.arange(n_frames), len(world_from_objects) - 1)
            positions = [transform(world_from_object, point) for world_from_object in world_from_objects]
            places[:, i] = np.stack(positions)[times]
    return places


def points_on_objects(picks: Sequence[Pick], recordings: Mapping[str, Known]) -> ObjectPoints:
    """Picked keypoints as points in the frames of their objects."""
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
    """Ground-truth label of the object that a keypoint was picked on: 0 is background, -1 unknown."""
    import numpy as np

    from bask_data.core.landings import label_at

    if truth is None or pick.camera not in truth.camera_names:
        return -1
    try:
        labels = truth.instance(pick.camera, pick.frame)
    except IndexError:
        return -1
    return int(label_at(labels, np.array([[pick.u, pick.v]]))[0])


def picked_point(pick: Pick, known: Known | None) -> np.ndarray | None:
    """Position (3,) of a pick, metres, world frame of its recording, from exact depth and pose if known.

    None without depth.
    """
    import numpy as np

    from bask_data.core.geometry import invert_rigid, transform, unproject
    from bask_data.core.match_errors import true_depth

    point = None if pick.point_world is None else np.array(pick.point_world, dtype=np.float64)
    truth = known.truth if known else None
    if known is None or truth is None or not truth.has_depth or pick.camera not in truth.camera_names:
        return point
    uv = np.array([[pick.u, pick.v]])
    depth, labels = truth.depth(pick.camera, pick.frame), truth.instance(pick.camera, pick.frame)
    z = true_depth(depth, labels, uv)
    if z[0] <= 0:
        return point
    world_from_camera = truth.world_from_cameras(pick.camera)[pick.frame]
    if known.recording is not None:
        return transform(world_from_camera, unproject(uv, z, known.recording.camera(pick.camera).Ks[pick.frame]))[0]
    if point is None:
        return None
    # Without intrinsics, the exact point is found on the ray of the picked one.
    camera = transform(invert_rigid(world_from_camera), point)
    return transform(world_from_camera, camera * z[0] / camera[2])


def label_of(truth: Truth, name: str, label: int) -> int:
    """The label of an object by name: `label` if it has that name, or else the first such label; -1 without one."""
    labels = [number for number, other in sorted(truth.label_names.items()) if name and other == name]
    return -1 if not labels else label if label in labels else labels[0]


def object_poses(truth: Truth) -> dict[int, np.ndarray]:
    """world_from_object by label, metres: (t, 4, 4), or (1, 4, 4) for static objects."""
    import numpy as np

    static = truth.metadata.world_from_object
    poses = {label: np.array(pose, dtype=np.float64)[None] for label, pose in static.items()}
    moving = truth.world_from_objects
    if moving is not None:
        poses |= {label: moving[:, i] for i, label in enumerate(truth.metadata.object_labels)}
    return poses


class TruePixels(NamedTuple):
    """Ground-truth pixels of points in one frame.

    Args:
        uv: (k, 2) pixels; NaN where unknown, or behind the camera.
        inside: (k,) bool: inside the image.
        hidden: (k,) bool: inside the image, but occluded.
    """

    uv: np.ndarray
    inside: np.ndarray
    hidden: np.ndarray


def true_pixels(points_world: np.ndarray, camera: Camera, truth: Truth | None, i_frame: int) -> TruePixels:
    """Pixels of world points (k, 3), metres, in a camera's frame, by exact depth and pose if known."""
    import numpy as np

    from bask_data.core.geometry import in_image, invert_rigid, project, transform

    exact = truth if truth is not None and truth.has_depth and camera.name in truth.camera_names else None
    cameras = exact.world_from_cameras(camera.name) if exact else camera.world_from_cameras
    depth = exact.depth(camera.name, i_frame) if exact else camera.depth(i_frame)
    uv, z = project(transform(invert_rigid(cameras[i_frame]), points_world), camera.Ks[i_frame])
    inside = in_image(uv, camera.height, camera.width)
    u, v = np.rint(np.where(inside[:, None], uv, 0)).astype(int).T
    shown = depth[v.clip(0, depth.shape[0] - 1), u.clip(0, depth.shape[1] - 1)]
    return TruePixels(uv, inside, inside & (shown > 0) & (z - shown > HIDDEN))
