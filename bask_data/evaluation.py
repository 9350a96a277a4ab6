"""How good the artifacts of a dataset are, held against its truth: what `bask-data evaluate` prints.

Only evaluation reads truth; no stage that makes data does.
"""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

from bask_data.artifact import MANIFEST, Artifact
from bask_data.dataset import Dataset
from bask_data.errors import BadData, UsageError
from bask_data.kinds import Correspondences, Scan, Truth, VisibleMasks
from bask_data.kinds.truth import ROBOT
from bask_data.progress import progress

if TYPE_CHECKING:
    import numpy as np


N_FRAMES_KEPT = 64
"""Frames of truth kept in memory; pairs come sorted by their first frame."""
LEAST_PIXELS = 100
"""Bodies that show fewer pixels in all frames together are not asked for."""


@dataclass(frozen=True)
class ObjectScore:
    """A body, or several that touch, and the instance it was paired with.

    Args:
        instance: 0 when none is left for it.
        iou: of the visible masks, over all frames at once.
    """

    names: tuple[str, ...]
    instance: int
    iou: float
    n_pixels: int


@dataclass(frozen=True)
class MaskScore:
    """The masks of one scene against its labels.

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
        """As many instances as bodies, those that touch counted as one."""
        return self.n_found == len(self.objects)


def masks_of(dataset: Dataset, scene: str) -> MaskScore:
    """Hold a scene's masks against its labels, in all cameras and frames that have both.

    Raises:
        BadData: they differ in size.
    """
    import numpy as np

    from bask_data.core import scores

    masks, truth = VisibleMasks(dataset.path(VisibleMasks, scene)), Truth(dataset.path(Truth, scene))
    groups = scores.joined(truth.touching)
    groups[ROBOT] = 0
    table = np.zeros((scores.N_LABELS, scores.N_LABELS), np.int64)
    n_frames = n_masked = n_on_robot = 0
    for name in [name for name in masks.camera_names if name in truth.camera_names]:
        camera = masks.camera(name)
        for i_frame in progress(range(camera.n_frames), f"measuring masks of {scene}"):
            labels, instance = truth.instance(name, i_frame), camera.instance(i_frame)
            if labels.shape != instance.shape:
                raise BadData(
                    masks.path / name,
                    "instance",
                    expected=f"images of the size of the true labels, {labels.shape}",
                    got=instance.shape,
                )
            table += scores.overlap(groups[labels], instance)
            n_on_robot += int(np.count_nonzero(instance[labels == ROBOT]))
            n_masked += int(np.count_nonzero(instance))
            n_frames += 1
    table[table.sum(axis=1) < LEAST_PIXELS] = 0
    return MaskScore(
        tuple(
            ObjectScore(_names(truth, groups, pair.label), pair.instance, pair.iou, pair.n_pixels)
            for pair in scores.paired_instances(table)
        ),
        masks.n_instances,
        n_frames,
        n_masked,
        n_on_robot,
    )


def _names(truth: Truth, groups: np.ndarray, label: int) -> tuple[str, ...]:
    """Names of the bodies in a group."""
    return tuple(name for one, name in sorted(truth.label_names.items()) if groups[one] == label)


@dataclass(frozen=True)
class MatchScore:
    """The matches of one scene against the exact depth and cameras.

    Args:
        error_px: of each match.
        n_hidden: matches whose point the second view cannot see.
    """

    error_px: np.ndarray
    n_hidden: int

    def figures(self) -> dict[str, float | None]:
        """What is told of them."""
        import numpy as np

        n = len(self.error_px)
        return {
            "matches": n,
            "median_px": float(np.median(self.error_px)) if n else None,
            "within_1px": float((self.error_px <= 1).mean()) if n else None,
            "within_2px": float((self.error_px <= 2).mean()) if n else None,
            "hidden": self.n_hidden,
        }


def matches_of(dataset: Dataset, scene: str) -> MatchScore:
    """Hold a scene's matches against its truth.

    Raises:
        BadData: the truth has no exact depth.
    """
    import numpy as np

    from bask_data.core import scores

    scan, truth = Scan(dataset.path(Scan, scene)), Truth(dataset.path(Truth, scene))
    correspondences = Correspondences(dataset.path(Correspondences, scene))
    if not truth.has_depth:
        raise BadData(
            truth.path, "depth", expected="exact depth and cameras", got="labels only", fix="bask-data ingest sim ROOT"
        )
    matches, n_done = correspondences.matches(), 0
    column = {name: matches[name].to_numpy() for name in matches.column_names}
    errors, n_hidden = [np.zeros(0)], 0
    seen = lru_cache(N_FRAMES_KEPT)(lambda camera, i: (truth.depth(camera, i), truth.instance(camera, i)))
    for pair in progress(correspondences.pairs().to_pylist(), f"measuring matches of {scene}"):
        mine = slice(n_done, n_done + pair["n_matches"])
        n_done = mine.stop
        uv_a, uv_b = (np.stack([column[f"u_{one}"][mine], column[f"v_{one}"][mine]], axis=1) for one in "ab")
        (depth_a, labels_a), (depth_b, _) = (seen(pair[f"camera_{one}"], pair[f"frame_{one}"]) for one in "ab")
        K_a, K_b = (scan.camera(pair[f"camera_{one}"]).K for one in "ab")
        a, b = (truth.world_from_cameras(pair[f"camera_{one}"])[pair[f"frame_{one}"]] for one in "ab")
        found = scores.match_errors(uv_a, uv_b, depth_a, depth_b, labels_a, K_a, K_b, a, b)
        errors.append(found.error_px)
        n_hidden += int(found.hidden().sum())
    return MatchScore(np.concatenate(errors), n_hidden)


def evaluated_correspondences(dataset: Dataset, only: Sequence[str] = ()) -> dict[str, Any]:
    """Scores of every scene that has matches and truth, and over all of them, as plain JSON values.

    `within_1px` and `within_2px` are shares of the matches, `hidden` is a number of them.
    """
    import numpy as np

    scored = {scene: matches_of(dataset, scene) for scene in _scenes(dataset, Correspondences, only)}
    everything = MatchScore(
        np.concatenate([score.error_px for score in scored.values()]), sum(score.n_hidden for score in scored.values())
    )
    return {"scenes": {scene: score.figures() for scene, score in scored.items()}, "all": everything.figures()}


def evaluated_masks(dataset: Dataset, only: Sequence[str] = ()) -> dict[str, Any]:
    """Scores of every scene that has masks and truth, and over all of them, as plain JSON values.

    `counted` is the share of scenes with as many instances as objects, `iou` the mean over objects, `worst` the least,
    `on_robot` the share of the masks' pixels that show the robot.
    """
    scored = {scene: masks_of(dataset, scene) for scene in _scenes(dataset, VisibleMasks, only)}
    objects = [one.iou for score in scored.values() for one in score.objects]
    n_pixels = sum(score.n_pixels for score in scored.values())
    everything = {
        "counted": _mean([score.count_is_right for score in scored.values()]),
        "iou": _mean(objects),
        "worst": min(objects, default=None),
        "on_robot": sum(score.n_on_robot for score in scored.values()) / n_pixels if n_pixels else None,
    }
    return {"scenes": {scene: asdict(score) for scene, score in scored.items()}, "all": everything}


def _mean(values: Sequence[float]) -> float | None:
    return sum(values) / len(values) if values else None


def _scenes(dataset: Dataset, kind: type[Artifact], only: Sequence[str]) -> list[str]:
    """The scenes asked for, or all that have both the artifact and truth.

    Raises:
        UsageError: there is none, or one asked for lacks either.
    """
    known = dataset.items("scene")
    for name in only:
        if name not in known:
            raise UsageError(dataset.root, "--only", expected=f"one of {', '.join(known) or 'no scenes'}", got=name)
    scenes = [
        name for name in only or known if all((dataset.path(one, name) / MANIFEST).exists() for one in (kind, Truth))
    ]
    if not scenes or (only and len(scenes) < len(only)):
        raise UsageError(
            dataset.root,
            ", ".join(name for name in only if name not in scenes),
            expected=f"a scene with truth and {kind.kind}",
            got="none",
            fix=f"bask-data run {shlex.quote(str(dataset.root))}; truth comes with `ingest sim` and with labelled "
            "recordings.",
        )
    return scenes
