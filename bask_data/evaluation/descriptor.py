"""How well descriptor networks find in held-out views what they saw in others."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from bask_data.dataset import Dataset
from bask_data.errors import UsageError
from bask_data.evaluation.frames import Frames
from bask_data.evaluation.held_out import HeldOut, held_out
from bask_data.evaluation.keypoints import keypoint_table
from bask_data.evaluation.matches import BINS, PairMatches, alike_pairs, candidate_pairs, spread_pairs
from bask_data.evaluation.search import ALPHA, ALPHAS, RADIUS, Cells, found_matches
from bask_data.evaluation.sweep import CONDITIONS, swept
from bask_data.kinds import DescriptorNet
from bask_data.progress import progress

if TYPE_CHECKING:
    import numpy as np

    from bask_data.core.descriptor_scores import Records
    from bask_data.nn.network import DescriptorNetwork

PAIRS_SWEPT = 8
"""One of so many pairs is zoomed and turned: each costs the network several further images."""


@dataclass(frozen=True)
class DescriptorSettings:
    """On what networks are measured, and how.

    Args:
        scenes: to measure on; by default what none of the networks was trained on.
        pairs: of frames, of each scene, at most.
        sweep: zoom and turn some of the views, too: `by_zoom` and `by_turn`.
        keypoints: number of those that are picked in a view trained on and looked for in others; 0 is none.
        alpha: temperature of the heat maps whose calibration is measured.
        seed: of the pairs and of the pixels looked for.
        one_may_be_learned: where frames are held out, but no matches join two of them, measure on pairs of which one
            frame was trained on, rather than not at all.
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

    `all` is of pairs of frames that were drawn blindly, and so are `curves` and `calibration`. What is told apart,
    `by_scale` and so on, is of these and of as many more that were chosen to fill the emptiest bins; so are the curves
    of `curves_by`, at the thresholds of `curves`.

    Args:
        against: by name, datasets with the same objects, or others of these names, to look for the keypoints in.

    Raises:
        UsageError: a scene or a variant is not there, nothing can be matched, or `alpha` is no temperature.
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
        raise UsageError(dataset.root, expected="frames that see the same objects", got=f"none in {aside.words}")
    found = {name: _told(scored) | _told_conditions(measured.turned[name]) for name, scored in measured.scores.items()}
    if settings.keypoints:
        table = keypoint_table(dataset, networks, aside, against or {}, settings.keypoints, settings.seed)
        found = {name: told | {"keypoints": table[name]} for name, told in found.items()}
    return {
        "measured_on": aside.words,
        "matches_by": measured.sources,
        "alpha": settings.alpha,
        "radius_share": RADIUS,
        "n_pairs": measured.n_pairs,
        "variants": found,
    }


def _network(dataset: Dataset, variant: str) -> DescriptorNetwork:
    return DescriptorNet(dataset.path(DescriptorNet, variant=variant)).network()


@dataclass(frozen=True)
class Scored:
    """What a network found of one pair's matches, with the names of their objects."""

    matches: PairMatches
    objects: tuple[str, ...]
    records: Records


@dataclass
class _Measured:
    """What networks found of the same pairs.

    Attributes:
        sources: what a scene's matches are known by.
        scores: by network, of each pair.
        turned: by network, under each condition of the sweep.
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
    """Look for the matches of a scene's pairs; frames are described once each, at the network's stride."""
    cells = Cells(network, frames)
    for pair in progress(matches, f"looking for matches of {frames.scene} with {name}"):
        objects = tuple(frames.objects[int(label)] for label in pair.label)
        yield Scored(pair, objects, found_matches(network, cells, frames, pair, alpha))


# Telling --------------------------------------------------------------------------------------------------------------


def _told(scored: Sequence[Scored]) -> dict[str, Any]:
    """Figures of one variant, over all that was drawn blindly and by whatever matches are told apart by."""
    import numpy as np

    from bask_data.core.descriptor_scores import LIMITS, Records, cumulative, figures

    everything = Records.joined([one.records for one in scored])
    random = np.repeat([one.matches.is_random for one in scored], [len(one.records) for one in scored])
    blind = everything.chosen(random)
    told: dict[str, Any] = {"all": figures(blind), "curves": {}, "curves_by": {}}
    for name, limit in LIMITS.items():
        thresholds, below = cumulative(getattr(blind, name), limit)
        told["curves"][name] = {"threshold": thresholds.tolist(), "share": _plain(below)}
    for what, rows in _groups(scored).items():
        told[f"by_{what}"] = {name: figures(everything.chosen(mine)) for name, mine in rows.items()}
        told["curves_by"][what] = {
            name: {
                metric: _plain(cumulative(getattr(everything, metric)[mine], limit)[1].round(4))
                for metric, limit in LIMITS.items()
            }
            for name, mine in rows.items()
        }
    told["calibration"] = _calibration(blind)
    return told


def _groups(scored: Sequence[Scored]) -> dict[str, dict[str, np.ndarray]]:
    """By what matches are told apart by and by name, which they are (n,) bool."""
    import numpy as np

    n_matches = [len(one.records) for one in scored]
    labels = {"object": np.array([name for one in scored for name in one.objects])}
    labels["scene"] = np.repeat([one.matches.scene for one in scored], n_matches)
    groups = {}
    for what, names in BINS.items():
        i_bin = np.concatenate([one.matches.bins()[what] for one in scored])
        groups[what] = {name: i_bin == i for i, name in enumerate(names)}
    for what, own in labels.items():
        groups[what] = {name: own == name for name in dict.fromkeys(own.tolist())}
    return groups


def _told_conditions(turned: Sequence[tuple[str, str, Records]]) -> dict[str, Any]:
    """Figures by zoom and by turn, if there are any."""
    from bask_data.core.descriptor_scores import Records, figures

    told: dict[str, Any] = {}
    for what, conditions in CONDITIONS.items() if turned else ():
        told[f"by_{what}"] = {
            name: figures(Records.joined([one for *key, one in turned if key == [what, name]])) for name in conditions
        }
    return told


def _calibration(records: Records) -> dict[str, Any]:
    """How true the heat maps are, and at which of some temperatures they would be truest."""
    from bask_data.core.descriptor_scores import reliability

    found, *others = (reliability(one, records.is_near) for one in records.confidence.T)
    errors = [one.error for one in others]
    return {
        "ece": found.error,
        "n": found.n.tolist(),
        "confidence": _plain(found.confidence),
        "accuracy": _plain(found.accuracy),
        "truest_alpha": ALPHAS[errors.index(min(errors))],
        "truest_ece": min(errors),
    }


def _plain(values: np.ndarray) -> list[float | None]:
    """Numbers for JSON, which knows no NaN."""
    return [None if value != value else value for value in values.tolist()]
