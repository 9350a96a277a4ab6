"""Keypoints from one view of a training scene, found in views of other scenes, other instances and other surroundings.

The protocol of von Hartz et al. 2023, Table S.1: random pixels of one observation, and how far from where they truly
are the network finds them. There the truth is a model of each object; here it is the objects' exact transforms.
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
from bask_data.evaluation.matches import drawn_pixels, shows
from bask_data.evaluation.search import ALPHA, described, descriptors_at, looked_for
from bask_data.kinds import Scan, Truth
from bask_data.kinds.places import ObjectPoints, carried, label_of
from bask_data.progress import progress

if TYPE_CHECKING:
    import numpy as np
    import torch

    from bask_data.nn.network import DescriptorNetwork

TRAINING, UNSEEN_VIEW = "training", "unseen view"
MOST_VIEWS = 20
"""Frames of a scene in which keypoints are looked for, evenly over time."""
N_SHAPE_POINTS = 2000
"""Points of an object's surface taken from a frame."""
SAME_EXTENTS = 0.004
"""Two bodies of a name are one where no side of their boxes is off by more metres. What is not seen of one makes it
seem smaller, by some millimetres."""


@dataclass(frozen=True)
class PickedPoints:
    """Points fixed to objects, and where they were picked.

    Attributes:
        objects: name of each one's object (k).
        points_object: (k, 3), metres, frame of that object.
        shapes: surface of each of these objects (m, 3), metres, in its frame, as the scenes trained on show it.
    """

    scene: str
    frame: Frame
    uv: np.ndarray
    objects: tuple[str, ...]
    points_object: np.ndarray
    shapes: dict[str, np.ndarray]


@dataclass(frozen=True)
class Place:
    """Where keypoints truly are in a view.

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
    """For each variant, each set of objects that occurs together and each column: figures of the keypoints' errors.

    Columns are the views trained on, those held out of training, and each dataset of `against`, whose truth names the
    same objects. Empty where truth knows no transforms.

    Raises:
        UsageError: `against` is given and truth does not know where objects are.
    """
    learned = [scene for scene in learned_scenes(dataset) if knows_places(dataset, scene)]
    unseen = [scene for scene in held_out.scenes if knows_places(dataset, scene)]
    others = {
        name: [scene for scene in one.items("scene") if knows_places(one, scene)] for name, one in against.items()
    }
    for one, scenes in [(dataset, learned), *((against[name], others[name]) for name in others)] if against else []:
        if not scenes:
            raise UsageError(one.root, "--against", expected="scenes whose truth knows transforms", got="none")
    table: dict[str, Any] = {name: {} for name in networks}
    for objects, scenes in _sets_of_objects(dataset, learned).items():
        # Where frames were held out rather than scenes, the training views are what comes before them.
        end = 1.0 - held_out.share if set(held_out.scenes) <= set(learned) and held_out.share < 1 else 1.0
        keypoints = _picked(dataset, scenes, end, n_keypoints, seed)
        places = {
            TRAINING: _places(keypoints, dataset, scenes, (0.0, end), is_other=False),
            UNSEEN_VIEW: _places(keypoints, dataset, unseen, (1.0 - held_out.share, 1.0), is_other=False),
            **{name: _places(keypoints, one, others[name], (0.0, 1.0), is_other=True) for name, one in against.items()},
        }
        for name, network in networks.items():
            image = described(network, Frames(dataset, keypoints.scene).rgb(keypoints.frame))
            references = descriptors_at(network, image, keypoints.uv)
            table[name]["+".join(objects)] = {
                column: _errors(network, references, found, f"looking for keypoints with {name}: {column}")
                for column, found in places.items()
                if found
            }
    return table


def knows_places(dataset: Dataset, scene: str) -> bool:
    """Whether truth knows a scene exactly, the objects' transforms included."""
    if not all((dataset.path(kind, scene) / MANIFEST).exists() for kind in (Scan, Truth)):
        return False
    truth = Frames(dataset, scene).truth
    return truth is not None and bool(truth.metadata.world_from_object)


def _sets_of_objects(dataset: Dataset, scenes: Sequence[str]) -> dict[tuple[str, ...], list[str]]:
    """Scenes by the objects that are in them."""
    found: dict[tuple[str, ...], list[str]] = {}
    for scene in scenes:
        found.setdefault(tuple(Frames(dataset, scene).objects.values()), []).append(scene)
    return found


def _picked(dataset: Dataset, scenes: Sequence[str], end: float, n: int, seed: int) -> PickedPoints:
    """Random pixels, as equally many of each object as can be, of the first scene's view that shows most of them.

    Args:
        end: share of each camera's frames, the first, that are taken into account.
    """
    import numpy as np

    from bask_data.core.geometry import invert_rigid, transform
    from bask_data.core.local_warp import surface_tangents

    rng, frames = np.random.default_rng([seed, 3]), Frames(dataset, scenes[0])
    frame = max(frames.between(0.0, end, MOST_VIEWS), key=lambda one: _shown(frames, one))
    labels, depth, world = frames.labels(frame), frames.depth(frame), frames.world_from_camera(frame)
    uv, label = drawn_pixels(frames, frame, depth > 0, n, rng)
    points = transform(world, surface_tangents(uv, depth, labels, frames.K(frame.camera))[0])
    poses = _world_from_objects(frames)
    return PickedPoints(
        frames.scene,
        frame,
        uv,
        tuple(frames.objects[int(one)] for one in label),
        np.stack([transform(invert_rigid(poses[int(one)]), point) for one, point in zip(label, points, strict=True)]),
        _shapes(dataset, scenes),
    )


def _shown(frames: Frames, frame: Frame) -> tuple[int, int]:
    """Number of objects a frame shows, and of their pixels."""
    import numpy as np

    n = np.bincount(frames.labels(frame).ravel(), minlength=256)[list(frames.objects)]
    return int((n > 0).sum()), int(n.sum())


def _world_from_objects(frames: Frames) -> dict[int, np.ndarray]:
    """By label, where each object stands."""
    import numpy as np

    assert frames.truth is not None
    return {label: np.array(pose) for label, pose in frames.truth.metadata.world_from_object.items()}


def _shapes(dataset: Dataset, scenes: Sequence[str]) -> dict[str, np.ndarray]:
    """By name, points of each object's surface in its own frame, as far as the scenes show it."""
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
    """Where the keypoints are in all views of some scenes that have their objects.

    Args:
        is_other: the objects may be other instances, so their shapes are held against each other.
    """
    wanted = set(keypoints.objects)
    having = [scene for scene in scenes if wanted & set(Frames(dataset, scene).objects.values())]
    points = _on_other_instances(keypoints, _shapes(dataset, having)) if is_other else keypoints.points_object
    places = []
    for frames in (Frames(dataset, scene) for scene in having):
        assert frames.truth is not None
        labels = tuple(label_of(frames.truth, name, 0) for name in keypoints.objects)
        # Scenes stand still: where their points are in one frame, they are in all.
        points_world = carried(ObjectPoints(labels, keypoints.objects, points), frames.truth, 1)[0]
        chosen = frames.between(*span, MOST_VIEWS)
        own = keypoints.frame if frames.scene == keypoints.scene and not is_other else None
        places += [_place(frames, frame, labels, points_world) for frame in chosen if frame != own]
    return places


def _on_other_instances(keypoints: PickedPoints, shapes: dict[str, np.ndarray]) -> np.ndarray:
    """The keypoints (k, 3) on instances of other shapes: at the same share of the box along each axis, and from there
    on to the nearest of the surface. What has the same box is the same instance."""
    import numpy as np
    from scipy.spatial import cKDTree

    moved = keypoints.points_object.copy()
    for name in {*keypoints.objects} & {*shapes}:
        mine = np.array([one == name for one in keypoints.objects])
        box, other = (np.stack([one.min(axis=0), one.max(axis=0)]) for one in (keypoints.shapes[name], shapes[name]))
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
    """Figures over all views: mean and standard deviation of the distance between the best match and where a keypoint
    is, pixels divided by the image's width and height, over the keypoints that are seen; the same of the heat map's
    mean; and how many are seen, hidden and outside the image."""
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
    told: dict[str, float | int | None] = {
        "views": len(places),
        "seen": int(seen.sum()),
        "hidden": int((states == HIDDEN).sum()),
        "outside": int((states == OUTSIDE).sum()),
    }
    for name, errors in (("", all_best), ("expected_", all_expected)):
        told[f"{name}mean"] = float(errors[seen].mean()) if seen.any() else None
        told[f"{name}std"] = float(errors[seen].std()) if seen.any() else None
    told["median"] = float(np.median(all_best[seen])) if seen.any() else None
    return told
