"""Keypoints from one view of a training scene, found in views of other scenes, other instances and other surroundings.

The protocol of von Hartz et al. 2023, Table S.1: random pixels of one observation, and the error of the network's best
match in others. There, ground truth is a model of each object; here, it is the objects' exact transforms.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from bask_data.artifact import MANIFEST
from bask_data.dataset import Dataset
from bask_data.errors import UsageError
from bask_data.evaluation.frames import Frames
from bask_data.evaluation.held_out import HeldOut, learned_scenes
from bask_data.evaluation.keypoint_places import HIDDEN, OUTSIDE, SEEN, Place, places_of
from bask_data.evaluation.picked_points import picked_points
from bask_data.evaluation.search import ALPHA, described, descriptors_at, looked_for
from bask_data.kinds import Scan, Truth
from bask_data.progress import progress

if TYPE_CHECKING:
    import torch

    from bask_data.nn.network import DescriptorNetwork

TRAINING, UNSEEN_VIEW = "training", "unseen view"


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
        keypoints = picked_points(dataset, scenes, end, n_keypoints, seed)
        places = {
            TRAINING: places_of(keypoints, dataset, scenes, (0.0, end), is_other=False),
            UNSEEN_VIEW: places_of(keypoints, dataset, unseen, (1.0 - held_out.share, 1.0), is_other=False),
            **{
                name: places_of(keypoints, other, others[name], (0.0, 1.0), is_other=True)
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
