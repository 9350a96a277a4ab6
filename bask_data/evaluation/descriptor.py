"""Evaluation of descriptor networks on matches between held-out views."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from bask_data.dataset import Dataset
from bask_data.errors import UsageError
from bask_data.evaluation.frames import Frames
from bask_data.evaluation.held_out import HeldOut, held_out
from bask_data.evaluation.keypoints import keypoint_table
from bask_data.evaluation.matches import alike_pairs, candidate_pairs, spread_pairs
from bask_data.evaluation.pair_matches import BINS, PairMatches
from bask_data.evaluation.search import ALPHA, ALPHAS, RADIUS, Cells, found_matches
from bask_data.evaluation.sweep import CONDITIONS, swept
from bask_data.kinds import DescriptorNet
from bask_data.progress import progress

if TYPE_CHECKING:
    import numpy as np

    from bask_data.core.descriptor_scores import Records
    from bask_data.nn.network import DescriptorNetwork

PAIRS_SWEPT = 8
"""One pair in this many is zoomed and turned, because each needs several more images through the network."""


@dataclass(frozen=True)
class DescriptorSettings:
    """What networks are measured on, and how.

    Args:
        scenes: to measure on; by default what none of the networks was trained on.
        pairs: pairs of frames per scene, at most.
        sweep: also zoom and turn some of the views: `by_zoom` and `by_turn`.
        keypoints: number of keypoints picked in a training view and looked for in others; 0 for none.
        alpha: temperature of the heat maps whose calibration is measured.
        seed: for drawing pairs and query pixels.
        one_may_be_learned: if no matches join two held-out frames, measure on pairs with one training frame rather than
            not at all.
    """

    scenes: Sequence[str] = ()
    pairs: int = 100
    sweep: bool = False
    keypoints: int = 0
    alpha: float = ALPHA
    seed: int = 0
    one_may_be_learned: bool = False


def evaluated_descriptor(
    dataset: Dataset,
    variants: Sequence[str] = ("main",),
    settings: DescriptorSettings | None = None,
    *,
    against: Mapping[str, Dataset] | None = None,
) -> dict[str, Any]:
    """Figures of each variant on the same matches, as plain JSON values.

    `all`, `curves` and `calibration` are for random pairs of frames. `by_scale` and the other breakdowns, and their
    curves `curves_by` at the thresholds of `curves`, add as many pairs chosen to fill the emptiest bins.

    Args:
        against: by name, datasets to look for the keypoints in, with the same objects or others of the same names.

    Raises:
        UsageError: a scene or variant does not exist, nothing can be matched, or `alpha` is negative or infinite.
        BadData: a network does not load.
    """
    settings = settings or DescriptorSettings()
    if not 0 <= settings.alpha < float("inf"):
        raise UsageError("evaluate descriptor", "--alpha", expected="a finite number, 0 or more", got=settings.alpha)
    aside = held_out(dataset, variants, settings.scenes)
    networks = {name: _network(dataset, name) for name in variants}
    measured = _measured(dataset, networks, aside, settings)
    if not measured.n_pairs and settings.one_may_be_learned and aside.share < 1:
        aside = aside.joined_with_learned()
        measured = _measured(dataset, networks, aside, settings)
    if not measured.n_pairs:
        fix = "choose other scenes with --scenes."
        if not settings.scenes:
            root = shlex.quote(str(dataset.root))
            fix = (
                f"hold out a scene with `bask-data split {root} --validation SCENE` and train again, or pass --scenes."
            )
        expected, got = "frames that see the same objects", f"none in {aside.words}"
        raise UsageError(dataset.root, expected=expected, got=got, fix=fix)
    figures = {
        name: _variant_figures(scored) | _sweep_figures(measured.turned[name])
        for name, scored in measured.scores.items()
    }
    if settings.keypoints:
        table = keypoint_table(dataset, networks, aside, against or {}, settings.keypoints, settings.seed)
        figures = {name: of_variant | {"keypoints": table[name]} for name, of_variant in figures.items()}
    return {
        "measured_on": aside.words,
        "matches_by": measured.sources,
        "alpha": settings.alpha,
        "radius_share": RADIUS,
        "n_pairs": measured.n_pairs,
        "variants": figures,
    }


def _network(dataset: Dataset, variant: str) -> DescriptorNetwork:
    return DescriptorNet(dataset.path(DescriptorNet, variant=variant)).network()


@dataclass(frozen=True)
class Scored:
    """One pair's matches with a network's records of them, and the names of their objects."""

    matches: PairMatches
    objects: tuple[str, ...]
    records: Records


@dataclass
class _Measured:
    """Records of several networks on the same pairs.

    Attributes:
        sources: by scene, what its matches are known from.
        scores: by network, for each pair.
        turned: by network, for each condition of the sweep.
    """

    sources: dict[str, str]
    scores: dict[str, list[Scored]]
    turned: dict[str, list[tuple[str, str, Records]]]

    @property
    def n_pairs(self) -> int:
        return len(next(iter(self.scores.values())))


def _measured(
    dataset: Dataset, networks: Mapping[str, DescriptorNetwork], aside: HeldOut, settings: DescriptorSettings
) -> _Measured:
    measured = _Measured({}, {name: [] for name in networks}, {name: [] for name in networks})
    for scene in aside.scenes:
        frames = Frames(dataset, scene)
        measured.sources[scene] = "exact depth and cameras" if frames.truth is not None else "correspondences"
        candidates = candidate_pairs(dataset, frames, aside, settings.seed)
        spread = spread_pairs(candidates, settings.pairs, settings.seed)
        alike = alike_pairs(candidates, max(settings.pairs // PAIRS_SWEPT, 1), settings.seed) if settings.sweep else []
        for name, network in networks.items():
            measured.scores[name] += _scored(network, frames, spread, settings.alpha, name)
            measured.turned[name] += swept(network, frames, alike, settings.alpha, name)
    return measured


def _scored(
    network: DescriptorNetwork, frames: Frames, matches: Sequence[PairMatches], alpha: float, name: str
) -> Iterator[Scored]:
    """Look for the matches of a scene's pairs; each frame is described once, at the network's stride."""
    cells = Cells(network, frames)
    for pair in progress(matches, f"looking for matches of {frames.scene} with {name}"):
        objects = tuple(frames.objects[int(label)] for label in pair.label)
        yield Scored(pair, objects, found_matches(network, cells, frames, pair, alpha))


# Figures --------------------------------------------------------------------------------------------------------------


def _variant_figures(scored: Sequence[Scored]) -> dict[str, Any]:
    """Figures of one variant over the random pairs, and by group of matches."""
    import numpy as np

    from bask_data.core.descriptor_scores import LIMITS, Records, cumulative, figures

    everything = Records.joined([pair.records for pair in scored])
    is_random = np.repeat([pair.matches.is_random for pair in scored], [len(pair.records) for pair in scored])
    random = everything.chosen(is_random)
    result: dict[str, Any] = {"all": figures(random), "curves": {}, "curves_by": {}}
    for name, limit in LIMITS.items():
        thresholds, below = cumulative(getattr(random, name), limit)
        result["curves"][name] = {"threshold": thresholds.tolist(), "share": _plain(below)}
    for what, rows in _groups(scored).items():
        result[f"by_{what}"] = {name: figures(everything.chosen(members)) for name, members in rows.items()}
        result["curves_by"][what] = {
            name: {
                metric: _plain(cumulative(getattr(everything, metric)[members], limit)[1].round(4))
                for metric, limit in LIMITS.items()
            }
            for name, members in rows.items()
        }
    result["calibration"] = _calibration(random)
    return result


def _groups(scored: Sequence[Scored]) -> dict[str, dict[str, np.ndarray]]:
    """The members (n,) bool of each group of matches, by kind of group and by name."""
    import numpy as np

    n_matches = [len(pair.records) for pair in scored]
    labels = {"object": np.array([name for pair in scored for name in pair.objects])}
    labels["scene"] = np.repeat([pair.matches.scene for pair in scored], n_matches)
    groups = {}
    for what, names in BINS.items():
        i_bin = np.concatenate([pair.matches.bins()[what] for pair in scored])
        groups[what] = {name: i_bin == i for i, name in enumerate(names)}
    for what, own in labels.items():
        groups[what] = {name: own == name for name in dict.fromkeys(own.tolist())}
    return groups


def _sweep_figures(turned: Sequence[tuple[str, str, Records]]) -> dict[str, Any]:
    """Figures by zoom and by turn, if these were swept."""
    from bask_data.core.descriptor_scores import Records, figures

    result: dict[str, Any] = {}
    for what, conditions in CONDITIONS.items() if turned else ():
        result[f"by_{what}"] = {
            name: figures(Records.joined([records for *key, records in turned if key == [what, name]]))
            for name in conditions
        }
    return result


def _calibration(records: Records) -> dict[str, Any]:
    """Calibration of the heat maps, and the temperature of `ALPHAS` at which it is best."""
    from bask_data.core.descriptor_scores import reliability

    at_alpha, *others = (reliability(confidence, records.is_near) for confidence in records.confidence.T)
    errors = [calibration.error for calibration in others]
    return {
        "ece": at_alpha.error,
        "n": at_alpha.n.tolist(),
        "confidence": _plain(at_alpha.confidence),
        "accuracy": _plain(at_alpha.accuracy),
        "truest_alpha": ALPHAS[errors.index(min(errors))],
        "truest_ece": min(errors),
    }


def _plain(values: np.ndarray) -> list[float | None]:
    """Values for JSON; NaN becomes None."""
    return [None if value != value else value for value in values.tolist()]
