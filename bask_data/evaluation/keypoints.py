"""Keypoints from one view of a training scene, found in views of other scenes, other instances and other surroundings.

The protocol of von Hartz et al. 2023, Table S.1: random pixels of one observation, and the error of the network's best
match in others. There, ground truth is a model of each object; here, it is the objects' exact transforms.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from bask_data.artifact import MANIFEST
from bask_data.dataset import Dataset
from bask_data.errors import UsageError
from bask_data.evaluation.frames import Frame, Frames
from bask_data.evaluation.held_out import HeldOut, learned_scenes
from bask_data.evaluation.search import ALPHA, described, descriptors_at, looked_for
from bask_data.evaluation.true_matches import drawn_pixels, shows
from bask_data.kinds import Scan, Truth
from bask_data.kinds.places import ObjectPoints, carried, label_of
from bask_data.progress import progress

if TYPE_CHECKING:
    import numpy as np
    import torch

    from bask_data.nn.network import DescriptorNetwork

TRAINING, UNSEEN_VIEW = "training", "unseen view"
MOST_VIEWS = 20
"""Frames of a scene in which keypoints are looked for, at most, evenly spaced."""
N_SHAPE_POINTS = 2000
"""Points of an object's surface taken from a frame."""
SAME_EXTENTS = 0.004
"""Objects of one name are the same instance if the sides of their boxes differ by at most this, metres: unseen parts
make an object seem smaller by some millimetres."""


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


def keypoint_table(
    dataset: Dataset,
    networks: Mapping[str, DescriptorNetwork],
    held_out: HeldOut,
    against: Mapping[str, Dataset],
    n_keypoints: int,
    seed: int,
) -> dict[str, dict[str, dict[str, dict[str, float | int | None]]]]:
    """Figures of the keypoints' errors, by variant, set of objects that occur together, and column.

    Columns are the training views, the held-out views, and each dataset of `against`, whose ground truth names the same
    objects. Empty without ground-truth transforms.

    Raises:
        UsageError: `against` is given, and there are no ground-truth transforms of objects.
    """
    learned = [scene for scene in learned_scenes(dataset) if knows_places(dataset, scene)]
    unseen = [scene for scene in held_out.scenes if knows_places(dataset, scene)]
    others = {
        name: [scene for scene in other.items("scene") if knows_places(other, scene)] for name, other in against.items()
    }
    for source, scenes in [(dataset, learned), *((against[name], others[name]) for name in others)] if against else []:
        if not scenes:
            raise UsageError(source.root, "--against", expected="scenes with ground-truth transforms", got="none")
    table: dict[str, Any] = {name: {} for name in networks}
    for objects, scenes in _sets_of_objects(dataset, learned).items():
        # Where frames are held out rather than scenes, the training views are the frames before them.
        end = 1.0 - held_out.share if set(held_out.scenes) <= set(learned) and held_out.share < 1 else 1.0
        keypoints = _picked(dataset, scenes, end, n_keypoints, seed)
        places = {
            TRAINING: _places(keypoints, dataset, scenes, (0.0, end), is_other=False),
            UNSEEN_VIEW: _places(keypoints, dataset, unseen, (1.0 - held_out.share, 1.0), is_other=False),
            **{
                name: _places(keypoints, other, others[name], (0.0, 1.0), is_other=True)
                for name, other in against.items()
            },
        }
        for name, network in networks.items():
            image = described(network, Frames(dataset, keypoints.scene).rgb(keypoints.frame))
            references = descriptors_at(network, image, keypoints.uv)
            table[name]["+".join(objects)] = {
                column: _errors(network, references, views, f"looking for keypoints with {name}: {column}")
                for column, views in places.items()
                if views
            }
    return table


def knows_places(dataset: Dataset, scene: str) -> bool:
    """Whether a scene has exact ground truth, including the objects' transforms."""
    if not all((dataset.path(kind, scene) / MANIFEST).exists() for kind in (Scan, Truth)):
        return False
    truth = Frames(dataset, scene).truth
    return truth is not None and bool(truth.metadata.world_from_object)


def _sets_of_objects(dataset: Dataset, scenes: Sequence[str]) -> dict[tuple[str, ...], list[str]]:
    """Scenes by the objects that are in them."""
    sets: dict[tuple[str, ...], list[str]] = {}
    for scene in scenes:
        sets.setdefault(tuple(Frames(dataset, scene).objects.values()), []).append(scene)
    return sets


def _picked(dataset: Dataset, scenes: Sequence[str], end: float, n: int, seed: int) -> PickedPoints:
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
    points = transform(world, surface_tangents(uv, depth, labels, frames.K(frame.camera))[0])
    poses = _world_from_objects(frames)
    return PickedPoints(
        frames.scene,
        frame,
        uv,
        tuple(frames.objects[int(i)] for i in label),
        np.stack([transform(invert_rigid(poses[int(i)]), point) for i, point in zip(label, points, strict=True)]),
        _shapes(dataset, scenes),
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


def _shapes(dataset: Dataset, scenes: Sequence[str]) -> dict[str, np.ndarray]:
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


def _places(
    keypoints: PickedPoints, dataset: Dataset, scenes: Sequence[str], span: tuple[float, float], is_other: bool
) -> list[Place]:
    """Ground truth of the keypoints in all views of the scenes that have their objects.

    Args:
        is_other: the objects may be other instances, so their shapes are compared.
    """
    wanted = set(keypoints.objects)
    having = [scene for scene in scenes if wanted & set(Frames(dataset, scene).objects.values())]
    points = _on_other_instances(keypoints, _shapes(dataset, having)) if is_other else keypoints.points_object
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
    uv, z = project(transform(invert_rigid(frames.world_from_camera(frame)), points_world), frames.K(frame.camera))
    seen = shows(frames, frame, uv, z, own)
    inside = in_image(uv, *frames.size(frame.camera))
    state = np.where(own < 0, ABSENT, np.where(~inside, OUTSIDE, np.where(seen, SEEN, HIDDEN)))
    return Place(frames, frame, uv, state)


def _errors(
    network: DescriptorNetwork, references: torch.Tensor, places: Sequence[Place], words: str
) -> dict[str, float | int | None]:
    """Figures over all views: mean and standard deviation of the distance between best match and ground truth, as
    shares of the image's width and height, over the visible keypoints; the same for the heat map's mean; and numbers of
    visible, occluded and out-of-view keypoints."""
    import numpy as np

    best, expected, state = [np.zeros(0)], [np.zeros(0)], [np.zeros(0, int)]
    for place in progress(places, words):
        height, width = place.frames.size(place.frame.camera)
        image = described(network, place.frames.rgb(place.frame))
        found = looked_for(network, references, image, np.nan_to_num(place.uv), ALPHA)
        best.append(np.linalg.norm((found.best - place.uv) / [width, height], axis=1))
        expected.append(np.linalg.norm((found.expected - place.uv) / [width, height], axis=1))
        state.append(place.state)
    all_best, all_expected, states = (np.concatenate(parts) for parts in (best, expected, state))
    seen = states == SEEN
    figures: dict[str, float | int | None] = {
        "views": len(places),
        "seen": int(seen.sum()),
        "hidden": int((states == HIDDEN).sum()),
        "outside": int((states == OUTSIDE).sum()),
    }
    for name, errors in (("", all_best), ("expected_", all_expected)):
        figures[f"{name}mean"] = float(errors[seen].mean()) if seen.any() else None
        figures[f"{name}std"] = float(errors[seen].std()) if seen.any() else None
    figures["median"] = float(np.median(all_best[seen])) if seen.any() else None
    return figures
