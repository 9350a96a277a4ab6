"""Visible masks compared with ground-truth labels."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

from bask_data.dataset import Dataset
from bask_data.errors import BadData
from bask_data.evaluation.identity_names import identity_names, outdated_scans
from bask_data.evaluation.scenes import scenes_with_truth
from bask_data.kinds import Truth, VisibleMasks
from bask_data.kinds.truth import ROBOT
from bask_data.progress import progress

if TYPE_CHECKING:
    import numpy as np

LEAST_PIXELS = 100
"""Objects that show fewer pixels in all frames together are left out."""


@dataclass(frozen=True)
class ObjectScore:
    """An object, or several that touch, and the instance paired with it.

    Args:
        instance: 0 if none is left for it.
        iou: of the visible masks, over all frames at once.
    """

    names: tuple[str, ...]
    instance: int
    iou: float
    n_pixels: int


@dataclass(frozen=True)
class MaskScore:
    """The masks of one scene compared with its labels.

    Args:
        n_found: instances of the scene.
        n_pixels: of all masks in all frames.
        n_on_robot: of those, pixels that show the robot.
    """

    objects: tuple[ObjectScore, ...]
    n_found: int
    n_frames: int
    n_pixels: int
    n_on_robot: int

    @property
    def count_is_right(self) -> bool:
        """Whether there are as many instances as objects, with touching ones counted as one."""
        return self.n_found == len(self.objects)


@dataclass
class MaskCounts:
    """Pixel counts of a scene's masks, over the selected frames of all cameras.

    Args:
        table: of `overlap` with the labels, if any; those of touching objects are one, and the robot's are background.
        n_pixels: by instance (256,).
        n_labelled_frames: frames with labels.
        n_labelled_pixels: of the masks in those.
        n_on_robot: of these, pixels that show the robot.
    """

    table: np.ndarray
    n_pixels: np.ndarray
    n_frames: int = 0
    n_labelled_frames: int = 0
    n_labelled_pixels: int = 0
    n_on_robot: int = 0


def count_masks(masks: VisibleMasks, truth: Truth | None, frames: Callable[[int], Sequence[int]] = range) -> MaskCounts:
    """Count the pixels of a scene's masks, and compare them with labels where there are any.

    Args:
        frames: selects some of a camera's frames, given their number.

    Raises:
        BadData: masks and labels differ in size.
    """
    import numpy as np

    from bask_data.core.label_overlap import N_LABELS, overlap

    groups = label_groups(truth)
    n = N_LABELS
    counts = MaskCounts(np.zeros((n, n), np.int64), np.zeros(n, np.int64))
    for name in masks.camera_names:
        camera = masks.camera(name)
        chosen = frames(camera.n_frames)
        counts.n_frames += len(chosen)
        for i_frame in progress(chosen, f"measuring masks of {masks.path.name}"):
            instance = camera.instance(i_frame)
            counts.n_pixels += np.bincount(instance.ravel(), minlength=n)
            if truth is None or name not in truth.camera_names:
                continue
            labels = truth.instance(name, i_frame)
            if labels.shape != instance.shape:
                raise BadData(
                    masks.path / name,
                    "instance",
                    expected=f"images of the ground-truth labels' size, {labels.shape}",
                    got=instance.shape,
                )
            counts.table += overlap(groups[labels], instance)
            counts.n_labelled_frames += 1
            counts.n_labelled_pixels += int(np.count_nonzero(instance))
            counts.n_on_robot += int(np.count_nonzero(instance[labels == ROBOT]))
    return counts


def label_groups(truth: Truth | None) -> np.ndarray:
    """The label (256,) that each label counts as: touching objects are one, the robot is background."""
    from bask_data.core.label_overlap import joined

    groups = joined(truth.touching if truth else [])
    groups[ROBOT] = 0
    return groups


def masks_of(dataset: Dataset, scene: str) -> MaskScore:
    """Compare a scene's masks with its labels, in all cameras and frames that have both.

    Raises:
        BadData: they differ in size.
    """
    from bask_data.core.label_overlap import paired_instances

    masks, truth = VisibleMasks(dataset.path(VisibleMasks, scene)), Truth(dataset.path(Truth, scene))
    counts, groups = count_masks(masks, truth), label_groups(truth)
    counts.table[counts.table.sum(axis=1) < LEAST_PIXELS] = 0
    return MaskScore(
        tuple(
            ObjectScore(_names(truth, groups, pair.label), pair.instance, pair.iou, pair.n_pixels)
            for pair in paired_instances(counts.table)
        ),
        masks.n_instances,
        counts.n_labelled_frames,
        counts.n_labelled_pixels,
        counts.n_on_robot,
    )


def _names(truth: Truth, groups: np.ndarray, label: int) -> tuple[str, ...]:
    """Names of the objects in a group."""
    return tuple(name for member, name in sorted(truth.label_names.items()) if groups[member] == label)


def evaluated_masks(dataset: Dataset, only: Sequence[str] = ()) -> dict[str, Any]:
    """Scores of each scene with masks and ground truth, and over all of them, as plain JSON values.

    `counted` is the share of scenes with as many instances as objects, `iou` the mean over objects, `worst` the
    smallest, `on_robot` the share of the masks' pixels that show the robot.

    If `identify` has been run, each object also has the `identity` of its instance, None for one without, `by_name` has
    figures over all scans by that name, and `outdated` lists scans whose masks have changed since.
    """
    scored = {scene: masks_of(dataset, scene) for scene in scenes_with_truth(dataset, VisibleMasks, only)}
    objects = [body.iou for score in scored.values() for body in score.objects]
    n_pixels = sum(score.n_pixels for score in scored.values())
    everything = {
        "counted": _mean([score.count_is_right for score in scored.values()]),
        "iou": _mean(objects),
        "worst": min(objects, default=None),
        "on_robot": sum(score.n_on_robot for score in scored.values()) / n_pixels if n_pixels else None,
    }
    result: dict[str, Any] = {"scenes": {scene: asdict(score) for scene, score in scored.items()}, "all": everything}
    names, outdated = identity_names(dataset), [scene for scene in outdated_scans(dataset) if scene in scored]
    if names or outdated:
        result |= {"by_name": _by_name(result["scenes"], names), "outdated": outdated}
    return result


def _by_name(scenes: dict[str, Any], names: Mapping[tuple[str, int], str]) -> dict[str, Any]:
    """Figures by name of the identity, which is entered in the objects of the scenes.

    `shows` has the objects that ground truth names there, and how often: several mean that `identify` took
    different objects for one.
    """
    members: dict[str, list[tuple[str, dict[str, Any]]]] = {}
    for scene, score in scenes.items():
        for body in score["objects"]:
            body["identity"] = names.get((scene, body["instance"]))
            if body["identity"] is not None:
                members.setdefault(body["identity"], []).append((scene, body))
    figures = {}
    for name in sorted(members):
        bodies = [body for _, body in members[name]]
        ious = [body["iou"] for body in bodies]
        figures[name] = {
            "n_scans": len({scene for scene, _ in members[name]}),
            "iou": _mean(ious),
            "worst": min(ious),
            "shows": dict(Counter("+".join(body["names"]) for body in bodies)),
        }
    return figures


def _mean(values: Sequence[float]) -> float | None:
    return sum(values) / len(values) if values else None
