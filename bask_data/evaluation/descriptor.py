"""How well descriptor networks find in held-out views what they saw in others."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from bask_data.dataset import Dataset
from bask_data.errors import UsageError
from bask_data.evaluation.frames import Frame, Frames
from bask_data.evaluation.held_out import held_out
from bask_data.evaluation.matches import BINS, PairMatches, scene_matches
from bask_data.kinds import DescriptorNet
from bask_data.progress import progress

if TYPE_CHECKING:
    import numpy as np
    import torch

    from bask_data.core.descriptor_scores import Records
    from bask_data.nn.network import DescriptorNetwork

ALPHA = 4.0
"""Temperature of heat maps; the one keypoints are read with by default."""
RADIUS = 0.04
"""Share of the image's diagonal within which a heat map's mass is its confidence, and a match is right."""


def evaluated_descriptor(
    dataset: Dataset,
    variants: Sequence[str] = ("main",),
    *,
    scenes: Sequence[str] = (),
    pairs: int = 100,
    alpha: float = ALPHA,
    seed: int = 0,
) -> dict[str, Any]:
    """Figures of each variant on the same matches, as plain JSON values.

    `all` is of pairs of frames that were drawn blindly. What is told apart, `by_scale` and so on, is of these and of as
    many more that were chosen to fill the emptiest bins.

    Args:
        scenes: to measure on; by default what none of the variants was trained on.
        pairs: of frames, of each scene, at most.
        alpha: temperature of the heat maps whose truthfulness is measured.

    Raises:
        UsageError: a scene or a variant is not there, or nothing can be matched.
    """
    aside = held_out(dataset, variants, scenes)
    scores: dict[str, list[Scored]] = {name: [] for name in variants}
    sources = {}
    for scene in aside.scenes:
        frames = Frames(dataset, scene)
        sources[scene] = "exact depth and cameras" if frames.truth is not None else "correspondences"
        matches = scene_matches(dataset, frames, aside, pairs, seed)
        for name in variants:
            network = _network(dataset, name)
            scores[name] += measured(network, frames, matches, alpha, name)
    if not any(scores.values()):
        raise UsageError(dataset.root, expected="frames that see the same objects", got=f"none in {aside.words}")
    return {
        "measured_on": aside.words,
        "matches_by": sources,
        "alpha": alpha,
        "radius_share": RADIUS,
        "n_pairs": len(scores[variants[0]]),
        "variants": {name: _told(scored) for name, scored in scores.items()},
    }


def _network(dataset: Dataset, variant: str) -> DescriptorNetwork:
    from bask_data.nn.network import load

    return load(dataset.path(DescriptorNet, variant=variant))


@dataclass(frozen=True)
class Scored:
    """What a network found of one pair's matches, with the names of their objects."""

    matches: PairMatches
    objects: tuple[str, ...]
    records: Records


def measured(
    network: DescriptorNetwork, frames: Frames, matches: Sequence[PairMatches], alpha: float, name: str
) -> Iterator[Scored]:
    """Look for the matches of a scene's pairs; frames are described once each, at the network's stride."""
    cells = _Cells(network, frames)
    for pair in progress(matches, f"looking for matches of {frames.scene} with {name}"):
        records = _records(network, cells, frames, pair, alpha)
        yield Scored(pair, tuple(frames.objects[int(label)] for label in pair.label), records)


class _Cells:
    """Descriptors of frames at the network's stride, which is a small part of what all their pixels would be."""

    def __init__(self, network: DescriptorNetwork, frames: Frames) -> None:
        self._network, self._frames = network, frames
        self._known: dict[Frame, torch.Tensor] = {}

    def __getitem__(self, frame: Frame) -> torch.Tensor:
        if frame not in self._known:
            self._known[frame] = self._network.cells(self._frames.rgb(frame))
        return self._known[frame]


def _records(network: DescriptorNetwork, cells: _Cells, frames: Frames, pair: PairMatches, alpha: float) -> Records:
    import numpy as np

    from bask_data.core.descriptor_scores import Records

    size_a, size_b = frames.size(pair.a.camera), frames.size(pair.b.camera)
    diagonal = float(np.hypot(*size_b))
    found = looked_for(network, (cells[pair.a], size_a, pair.uv_a), (cells[pair.b], size_b, pair.uv_b), alpha)
    return Records(
        error_px=found.error_px,
        error_share=found.error_px / diagonal,
        error_3d=_error_3d(frames, pair, found.best),
        closer_share=found.closer_share,
        false_positive_px=found.false_positive_px,
        false_positive_share=found.false_positive_px / diagonal,
        confidence=found.confidence,
        is_near=found.error_px <= RADIUS * diagonal,
    )


View = tuple["torch.Tensor", tuple[int, int], "np.ndarray"]
"""Cells of an image, its (height, width), and pixels of it."""


def looked_for(network: DescriptorNetwork, a: View, b: View, alpha: float) -> Any:
    """What distance maps of one image say of pixels of another: `core.descriptor_scores.MapScores`."""
    import numpy as np

    from bask_data.core.descriptor_scores import map_scores
    from bask_data.nn.network import distance_maps
    from bask_data.nn.resnet import upsampled

    queries, truths = (described_at(network, *view) for view in (a, b))
    cells, size, uv = b
    maps = distance_maps(upsampled(cells[None], network.input_size(size))[0], queries).cpu().numpy()
    at_truth = (queries - truths).square().sum(dim=1).sqrt().cpu().numpy() / np.sqrt(queries.shape[1])
    return map_scores(maps, at_truth.astype(np.float64), uv, size, alpha, RADIUS * float(np.hypot(*size)))


def described_at(
    network: DescriptorNetwork, cells: torch.Tensor, size: tuple[int, int], uv: np.ndarray
) -> torch.Tensor:
    """Descriptors (n, d) at pixels of an image of this size, between the centres of its cells."""
    import numpy as np
    import torch

    from bask_data.core.geometry import scale_pixels
    from bask_data.nn.resnet import sampled

    scaled = scale_pixels(uv.astype(np.float64), size, network.input_size(size)).astype(np.float32)
    return sampled(cells[None], torch.from_numpy(scaled).to(cells.device)[None])[0]


def _error_3d(frames: Frames, pair: PairMatches, best: np.ndarray) -> np.ndarray:
    """Metres between the surface at the best matches and the true points; NaN without depth."""
    import numpy as np

    from bask_data.core.geometry import unproject
    from bask_data.core.scores import true_depth

    z = true_depth(frames.depth(pair.b), frames.labels(pair.b), best)
    found = unproject(best, np.where(z > 0, z, np.nan), frames.K(pair.b.camera))
    return np.linalg.norm(found - pair.points_b, axis=1)


# Telling --------------------------------------------------------------------------------------------------------------


def _told(scored: Sequence[Scored]) -> dict[str, Any]:
    """Figures of one variant, over all that was drawn blindly and by whatever matches are told apart by."""
    import numpy as np

    from bask_data.core.descriptor_scores import LIMITS, Records, cumulative, figures

    everything = Records.joined([one.records for one in scored])
    random = np.repeat([one.matches.is_random for one in scored], [len(one.records) for one in scored])
    blind = everything.chosen(random)
    told: dict[str, Any] = {"all": figures(blind)}
    for what, names in BINS.items():
        i_bin = np.concatenate([one.matches.bins()[what] for one in scored])
        told[f"by_{what}"] = {name: figures(everything.chosen(i_bin == i)) for i, name in enumerate(names)}
    objects = np.array([name for one in scored for name in one.objects])
    told["by_object"] = {name: figures(everything.chosen(objects == name)) for name in dict.fromkeys(objects.tolist())}
    scene = np.repeat([one.matches.scene for one in scored], [len(one.records) for one in scored])
    told["by_scene"] = {name: figures(everything.chosen(scene == name)) for name in dict.fromkeys(scene.tolist())}
    told["curves"] = {}
    for name, limit in LIMITS.items():
        thresholds, below = cumulative(getattr(blind, name), limit)
        told["curves"][name] = {"threshold": thresholds.tolist(), "share": _plain(below)}
    told["calibration"] = _calibration(blind)
    return told


def _calibration(records: Records) -> dict[str, Any]:
    from bask_data.core.descriptor_scores import reliability

    found = reliability(records.confidence, records.is_near)
    return {
        "ece": None if found.error != found.error else found.error,
        "n": found.n.tolist(),
        "confidence": _plain(found.confidence),
        "accuracy": _plain(found.accuracy),
    }


def _plain(values: np.ndarray) -> list[float | None]:
    """Numbers for JSON, which knows no NaN."""
    return [None if value != value else value for value in values.tolist()]
