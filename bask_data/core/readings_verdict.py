"""Which of the hypotheses about a recording is best, and which rivals it beats, pair of frames by pair of frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.special import stdtrit

from bask_data.core.readings_evidence import AT_REST, NO_TRANSLATION, PairedViews, Trial
from bask_data.core.readings_search import SAME_SCALE
from bask_data.core.warped_depth import MIN_MEASURED

SURE_P, SURE_GAIN = 0.0086, 0.01
"""A hypothesis beats another if its mean evidence is larger by this gain, and a paired t test gives a smaller
probability: t > 2.5 for 36 pairs, larger for fewer."""

MOVED_P = 0.0267
"""The same for the rival that the camera did not move: t > 2 for 36 pairs."""

CLAIM_P, CLAIM_GAIN = 0.002, 0.02
"""The same for claiming another clock or other intrinsics than those read: t > 3.1 for 36 pairs. A false alarm costs
more here than a fault that is missed."""

LEAST_JUDGED_PAIRS = 4
"""Pairs below which nothing is sure: the standard error of fewer is a guess."""

POOR_EVIDENCE = 0.25
"""Mean evidence below which depth and poses do not fit under a hypothesis. Exact synthetic data have 0.86, hand-held
recordings 0.5 to 0.7, a depth noise of 2 % allows 0.45."""

DISTINCT, LASTING = 0.75, 0.9
"""Evidence of other readings, as a share of the best, and evidence of all pairs, as a share of that of near ones. Right
readings of simulated recordings have up to 0.78 and at least 0.68, but not both; poses of others 0.77 to 0.94 and 0.71
to 0.86. Chosen on some 40 of them (benchmarks/doctor_statistics.py, seeds below 240)."""

FINE_SCALES = np.geomspace(0.5, 2.0, 57)
"""Around the best unit, 2.5 % apart: what is not largest near 1 is no unit."""

FINE_K = (1.0, 0.85, 1 / 0.85)
"""Around the best intrinsics along u and v: nearer than any two sizes of images that are tried."""


POOR_SHARE = 0.5
"""The same as a share of what noise allows, for depth that is so noisy that right poses have less, as with 6 % per
pixel. Poses of others have up to 0.45 of it, right ones at least 0.6 (benchmarks/doctor_statistics.py, seeds below
240)."""


@dataclass(frozen=True)
class Verdict:
    """The best of some trials, and what it beats.

    Args:
        mean: evidence of each trial, over the pairs that overlap under the best one.
        poor: evidence below which depth and poses do not fit.
        near: evidence of the best one for the pairs that are least apart.
        other: largest evidence of another reading of the poses.
        unbeaten: trials that the best does not beat.
        moved: whether it beats the camera that does not move.
        translates: whether it beats the camera that only turns.
        fine: factor of the scale at which evidence is largest, near 1 if the unit is right.
        is_fine_K: whether no intrinsics between the sizes that are tried fit better.
    """

    trials: list[Trial]
    best: int
    mean: Float[ndarray, " h"]
    overlapping: int
    poor: float
    near: float
    other: float
    unbeaten: tuple[Trial, ...]
    moved: bool
    translates: bool
    fine: float
    is_fine_K: bool
    beats_clocks: bool
    beats_intrinsics: bool
    beats_rays: bool

    @property
    def trial(self) -> Trial:
        """The best one."""
        return self.trials[self.best]

    @property
    def share(self) -> float:
        """Evidence of the best one."""
        return float(self.mean[self.best])

    @property
    def is_supported(self) -> bool:
        """Whether there is enough to be sure of anything."""
        enough = self.overlapping >= LEAST_JUDGED_PAIRS and self.share >= self.poor
        return enough and self.moved and self.is_distinct

    @property
    def is_distinct(self) -> bool:
        """Whether it stands out from other readings, or fits frames far apart about as well as near ones. Poses of
        other images fit near frames under some reading, but neither."""
        return self.other <= DISTINCT * self.share or self.share >= LASTING * self.near

    @property
    def sure_of_reading(self) -> bool:
        """Whether it beats all other readings of the poses."""
        return self.is_supported and all(trial.reading == self.trial.reading for trial in self.unbeaten)

    @property
    def sure_of_unit(self) -> bool:
        """Whether it beats all other scales, too, and is the best scale around."""
        same = all(is_same_scale(trial.scale, self.trial.scale) for trial in self.unbeaten)
        is_told = self.trial.scale == 1 and self.trial.K_factor == (1.0, 1.0)
        is_fine = not self.is_off_scale and (is_told or self.is_fine_K)
        return self.sure_of_reading and self.translates and same and is_fine

    @property
    def is_off_scale(self) -> bool:
        """Whether depth fits better at a scale that is no usual unit."""
        return bool(abs(np.log(self.fine)) >= SAME_SCALE)

    @property
    def sure_of_clock(self) -> bool:
        """Whether it beats all other clocks clearly."""
        return self.is_supported and self.beats_clocks

    @property
    def sure_of_intrinsics(self) -> bool:
        """Whether it beats all other intrinsics clearly."""
        return self.is_supported and self.beats_intrinsics and self.is_fine_K

    @property
    def sure_of_ray(self) -> bool:
        """Whether it beats the other meaning of depth's values clearly."""
        return self.is_supported and self.beats_rays


def verdict(
    views: PairedViews, trials: list[Trial], met: Float[ndarray, "h p"], seen: Float[ndarray, "h p"]
) -> Verdict:
    """The best of the trials. Between those that differ only in clock, intrinsics and what depth measures, one as read
    is preferred unless it is beaten."""
    is_known = np.array([trial.reading != AT_REST and trial.scale != NO_TRANSLATION for trial in trials])
    top = int(np.argmax(np.where(is_known, met.mean(axis=1), -1)))
    best = _plainest(trials, met, top)
    overlap = seen[best] >= MIN_MEASURED
    fine = _fine(views, trials[best])
    # Of poses without a unit, intrinsics as read would be blamed for what the nearest unit is off.
    around = trials[best]._replace(scale=trials[best].scale * (fine if trials[best].K_factor == (1.0, 1.0) else 1.0))
    index = {trial: i for i, trial in enumerate(trials)}
    unbeaten = []
    for i, trial in enumerate(trials):
        # The same clock, intrinsics and meaning of depth cost or gain a rival as much as the best, by chance.
        alike = index.get(trials[top]._replace(K_factor=trial.K_factor, lag=trial.lag, ray=trial.ray), top)
        if i in (best, top) or trial.reading == AT_REST:
            continue
        if not any(beats(met[k], met[i], SURE_P, SURE_GAIN) for k in (top, alike)):
            unbeaten.append(trial)
    still = met[trials.index(Trial(AT_REST))]
    turning = [met[i] for i, trial in enumerate(trials) if trial.scale == NO_TRANSLATION]
    mean = met.mean(axis=1)
    gaps = np.array([b - a for a, b in views.pairs])
    others = [mean[i] for i, trial in enumerate(trials) if trial.reading not in (AT_REST, trials[best].reading)]
    return Verdict(
        trials=trials,
        best=best,
        mean=met[:, overlap].mean(axis=1) if overlap.any() else np.zeros(len(trials)),
        overlapping=int(overlap.sum()),
        poor=min(POOR_EVIDENCE, POOR_SHARE * views.ceiling()),
        near=float(met[best][gaps <= np.unique(gaps)[:2].max()].mean()),
        other=float(max(others, default=0.0)),
        unbeaten=tuple(unbeaten),
        moved=beats(met[top], still, MOVED_P, 0.0),
        translates=all(beats(met[top], each, SURE_P, SURE_GAIN) for each in turning),
        fine=fine,
        is_fine_K=_is_fine_K(views, around),
        beats_clocks=claims(trials, met, best, "lag"),
        beats_intrinsics=claims(trials, met, best, "K_factor"),
        beats_rays=claims(trials, met, best, "ray"),
    )


def beats(
    winner: Float[ndarray, " p"], other: Float[ndarray, " p"], p: float = SURE_P, gain: float = SURE_GAIN
) -> bool:
    """Whether one hypothesis' evidence is larger than another's, by a paired t test over the pairs of frames.

    Pairs share frames and surfaces, so that they are fewer than they count for, and `p` is a threshold, no rate of
    errors. How often it misleads is measured: benchmarks/doctor_statistics.py.
    """
    difference = winner - other
    n = len(difference)
    if n < LEAST_JUDGED_PAIRS or difference.mean() <= gain:
        return False
    error = float(difference.std(ddof=1)) / np.sqrt(n)
    return bool(difference.mean() > float(stdtrit(n - 1, 1 - p)) * error)


def is_same_scale(a: float, b: float) -> bool:
    """Whether two scales mean the same unit."""
    return bool(a == b or abs(np.log(a / b)) < SAME_SCALE)


def claims(trials: Sequence[Trial], met: Float[ndarray, "h p"], best: int, field: str) -> bool:
    """Whether the best hypothesis beats all with another value of a field: clearly those with the value as read."""
    value, plain = getattr(trials[best], field), getattr(Trial(0), field)
    for i, trial in enumerate(trials):
        other = getattr(trial, field)
        p, gain = (CLAIM_P, CLAIM_GAIN) if other == plain or value == plain else (SURE_P, 0.0)
        if other != value and trial.reading != AT_REST and not beats(met[best], met[i], p, gain):
            return False
    return True


def _plainest(trials: Sequence[Trial], met: Float[ndarray, "h p"], best: int) -> int:
    """The best trial, or one of the same reading and scale that departs less from what was read and is not beaten."""

    def departures(trial: Trial) -> int:
        return sum(getattr(trial, name) != getattr(plain, name) for name in ("K_factor", "lag", "ray"))

    plain = Trial(0)
    order = np.argsort(-met.mean(axis=1), kind="stable")
    alike = [int(i) for i in order if trials[i][:2] == trials[best][:2]]
    unbeaten = [i for i in alike if i == best or not beats(met[best], met[i], CLAIM_P, CLAIM_GAIN)]
    return min(unbeaten, key=lambda i: departures(trials[i]))


def _fine(views: PairedViews, trial: Trial) -> float:
    """Factor of a trial's scale at which its evidence is largest."""
    mean = views.scores([trial._replace(scale=trial.scale * factor) for factor in FINE_SCALES])[0].mean(axis=1)
    return float(FINE_SCALES[int(np.argmax(mean))])


def _is_fine_K(views: PairedViews, trial: Trial) -> bool:
    """Whether a trial's evidence is largest among those with somewhat other intrinsics."""
    kx, ky = trial.K_factor
    around = [trial._replace(K_factor=(kx * along_u, ky * along_v)) for along_u, along_v in product(FINE_K, FINE_K)]
    return around[int(np.argmax(views.scores(around)[0].mean(axis=1)))] == trial
