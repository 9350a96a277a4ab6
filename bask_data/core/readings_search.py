"""The search for hypotheses that depth may support: coarse over all together, then the best of each kind in full."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations, product
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from bask_data.core.readings_evidence import AT_REST, NO_TRANSLATION, PairedViews, Trial

ENCODINGS = (1.0, 1e-3, 1e-4, 1 / 5000, 1 / 4000, 1e-2, 1e-1, 1 / 256, 1 / 1024)
"""Metres per unit of depth files in use, the most common first: metres, millimetres, 0.1 mm, TUM's, scanners',
centimetres, decimetres (never meant, but a slip of ten), KITTI's and some simulators'."""

SAME_SCALE = 0.12
"""Share by which a scale may be off and still mean the same unit: less than between 1/4000 and 1/5000 m."""

K_FACTORS = (
    *((s, s) for s in (0.25, 1 / 3, 0.5, 2 / 3, 0.75, 4 / 3, 1.5, 2.0, 3.0, 4.0)),
    *((2.0, 1.5), (0.5, 2 / 3), (3.0, 2.25), (1 / 3, 4 / 9), (1.0, 0.75), (1.0, 4 / 3)),
)
"""Ratios of the sizes that one camera's images come in: multiples, and 640x480 against 1280x720, 1920x1080, 640x360."""

COARSE_PAIRS, COARSE_STEP = 14, 6
"""Pairs, and one of so many points, of the coarse search. Sensitivity not measured."""

KEPT_OVERALL, KEPT_PER_KIND = 24, 3
"""Hypotheses that the coarse search hands on: the best of all, and of those with the same reading, scale and so on."""

HOPELESS = 0.12
"""Mean evidence by which a hypothesis may lie behind the best in the coarse search; farther ones count as beaten. A few
times the noise of the coarse search: evidence of 2000 points is uncertain by 0.01, of 14 pairs by some 0.03."""

MOST_ROUNDS = 3
"""Of looking around the best hypothesis found."""


def scales() -> tuple[float, ...]:
    """Ratios of common units of depth, and of poses in mm and cm, none twice within `SAME_SCALE`."""
    ratios = [1.0, *(10.0**e for e in (-1, 1, -2, 2, -3, 3))]
    for n in range(2, len(ENCODINGS) + 1):
        ratios += [a / b for a, b in product(ENCODINGS[:n], ENCODINGS[:n])]
    chosen: list[float] = []
    for ratio in ratios:
        if all(abs(np.log(ratio / other)) > SAME_SCALE / 2 for other in chosen):
            chosen.append(float(ratio))
    return tuple(chosen)


@dataclass(frozen=True)
class Space:
    """Values that are tried for each field of a trial; the first of each is "as read"."""

    readings: tuple[int, ...]
    scales: tuple[float, ...]
    K_factors: tuple[tuple[float, float], ...]
    lags: tuple[int, ...]
    rays: tuple[int, ...]

    def all(self) -> Iterator[Trial]:
        """Every combination but those with other meanings of depth's values, which differ little."""
        for values in product(self.readings, (*self.scales, NO_TRANSLATION), self.K_factors, self.lags):
            yield Trial(*values)

    def near(self, trial: Trial) -> Iterator[Trial]:
        """Trials that differ in one or two fields."""
        values: dict[str, tuple[Any, ...]] = {
            "reading": self.readings,
            "scale": (*self.scales, NO_TRANSLATION),
            "K_factor": self.K_factors,
            "lag": self.lags,
            "ray": self.rays,
        }
        for first, second in combinations(values, 2):
            for a, b in product(values[first], values[second]):
                yield trial._replace(**{first: a, second: b})


def other_sizes(K: Float[ndarray, "3 3"], size: tuple[int, int]) -> tuple[tuple[float, float], ...]:
    """Factors by which intrinsics may be for images of another size: those that bring the principal point nearer to the
    middle of the image. Few lenses are off it, and a change of size moves it far.

    Args:
        size: height and width.
    """

    def off(kx: float, ky: float) -> float:
        u, v = (K[0, 2] + 0.5) * kx / size[1], (K[1, 2] + 0.5) * ky / size[0]
        return float(max(abs(u - 0.5), abs(v - 0.5)))

    nearest = min(off(*factors) for factors in K_FACTORS)
    most = min(off(1.0, 1.0) - NEARER, nearest + AS_NEAR)
    return tuple(factors for factors in K_FACTORS if off(*factors) < most)


NEARER = 0.04
"""Share of the image's size by which the principal point must come nearer. That of RealSense and Kinect is within 0.03
of the middle; 4/3 and 3/4 move it by 0.17 and 0.12."""

AS_NEAR = 0.1
"""Share of the image's size by which it may stay farther from the middle than under the best factor."""


def searched(views: PairedViews, space: Space) -> tuple[list[Trial], Float[ndarray, "h p"], Float[ndarray, "h p"]]:
    """Hypotheses that came out well, all that differ from the best in one field, and those that nothing moved.

    Returns:
        The hypotheses, the best one first; evidence of each and pair; share of the points that was measured.
    """
    n = len(views.pairs)
    chosen = np.unique(np.linspace(0, n - 1, min(n, COARSE_PAIRS)).astype(int)).tolist()
    told = Trial(space.readings[0])
    trials = _kept(views, list(space.all()), chosen)
    turning = [Trial(reading, NO_TRANSLATION) for reading in space.readings]
    kept = _kept(views, _unique([*trials, *space.near(told)]), chosen)
    trials = _unique([told, Trial(AT_REST), *turning, *kept])
    met, seen = views.scores(trials)
    looked_around = {told, Trial(AT_REST)}
    for _ in range(MOST_ROUNDS):
        best = trials[int(np.argmax(met.mean(axis=1)))]
        if best in looked_around:
            break
        looked_around.add(best)
        known = set(trials)
        around = [trial for trial in _unique(space.near(best)) if trial not in known]
        kept = _kept(views, around, chosen)
        if not kept:
            break
        more = views.scores(kept)
        trials, met, seen = trials + kept, np.vstack([met, more[0]]), np.vstack([seen, more[1]])
    return trials, met, seen


def _kept(views: PairedViews, trials: Sequence[Trial], chosen: list[int]) -> list[Trial]:
    """The best by a few pairs and points: overall, and of each value of each field."""
    if not trials:
        return []
    mean = views.scores(trials, chosen, COARSE_STEP)[0].mean(axis=1)
    order = np.argsort(-mean, kind="stable")
    order = order[mean[order] >= mean[order[0]] - HOPELESS]
    kept = {int(i) for i in order[:KEPT_OVERALL]}
    for k_field in range(len(Trial._fields)):
        count: dict[object, int] = {}
        for i in order:
            value = trials[i][k_field]
            if count.get(value, 0) < KEPT_PER_KIND:
                count[value] = count.get(value, 0) + 1
                kept.add(int(i))
    return [trials[i] for i in sorted(kept)]


def _unique(trials: Iterable[Trial]) -> list[Trial]:
    return list(dict.fromkeys(trials))
