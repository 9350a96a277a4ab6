"""Temperature and tau of each keypoint, measured: what a descriptor distance tells of where a keypoint is.

A filter compares positions: the track, positions that matched in some other frame, and *not visible*. A frame's part in
that comparison is exp(-alpha z) / tau, an estimate of the likelihood ratio f_true(z) / f_rival(z): z is distributed as
f_true at the keypoint, and as f_rival at its rivals, the positions that matched best in another frame. Both are
followed to other frames, from near and from far. So a rival that deceives a network in ten frames in a row counts as
what it is, one error seen ten times, and alpha needs no further correction for the correlation of successive frames.

Distances of a whole frame rise and fall together, with the distance of the camera for example. They are therefore
compared with the frame's level, -log(mean of exp(-alpha z)) / alpha, and tau is a multiple of that mean.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from bask_data.core.log_ratio import log_ratio

SHRINKAGE = 20
"""Frames of the average keypoint that are added to each keypoint's own, so that a few of them decide little. Chosen,
sensitivity not measured."""

LEAST_SIGHTINGS = 8
"""Frames of one scan that must show its keypoints, on average, to calibrate with: fewer hardly differ in view. Chosen,
sensitivity not measured."""

LEAST_ALPHA, MOST_TAU_RATIO = 2.0, 2.0
"""Bounds of what is measured, the values of a filter that nothing was measured for. Networks match better in frames
they were trained on than in new ones: on two simulated tasks, the median of z less the level at true pixels was -1.6 in
a training scan and -0.7 in demonstrations, and tau as measured in the scan lost visible keypoints (error 107 mm instead
of 57). So the measurement may lower tau and not raise it. And where it finds that rivals match as well as the keypoint,
alpha below 2 makes neither of them a worse match (80 mm with alpha 1)."""

UNTOLD_TAU = 0.5 * 0.5**0.5
"""Upper bound of tau over the usual match, where alpha is at its bound. Derived: half, as a track counts as found where
it matches twice better than tau, times the mean of p_d, 1/sqrt(2), of depths that vary as the filter assumes."""

TEMPERATURES = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0)
"""Temperatures that levels and mean pixels of the frames are measured at."""

N_ROUNDS = 8
"""Rounds in which alpha and the level at this alpha are fitted in turn. Two more change nothing in the third digit."""


@dataclass(frozen=True)
class Calibration:
    """What distances of k keypoints are worth to the filters.

    Attributes:
        alpha: temperature over many frames: a pixel at distance z has likelihood exp(-alpha z).
        tau_ratio: likelihood of an image that does not show the keypoint, over that at its average pixel.
        sharp_alpha: temperature of a single frame's heat map, whose mean pixel is nearest to the keypoint.
    """

    alpha: Float[ndarray, "k"]
    tau_ratio: Float[ndarray, "k"]
    sharp_alpha: Float[ndarray, "k"]


@dataclass(frozen=True)
class Evidence:
    """Descriptor distances at keypoints and at their rivals, in frames in which these are visible.

    Attributes:
        true: distance at the keypoint, in frames other than that of the pick.
        true_of: index of its keypoint.
        true_level: level of the frame at each of `TEMPERATURES`.
        rival: distance at a rival, in frames other than that in which it matched best.
        rival_of: index of its keypoint.
        rival_level: level of the frame.
        off: for each of `true` and of `TEMPERATURES`, distance of the heat map's mean pixel from the keypoint, as a
            share of the image's diagonal.
    """

    true: Float[ndarray, "n"]
    true_of: Int[ndarray, "n"]
    true_level: Float[ndarray, "n a"]
    rival: Float[ndarray, "m"]
    rival_of: Int[ndarray, "m"]
    rival_level: Float[ndarray, "m a"]
    off: Float[ndarray, "n a"]


def joined(parts: Sequence[Evidence]) -> Evidence:
    """The samples of several scans, at least one."""
    return Evidence(*(np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(Evidence)))


def calibrated(evidence: Evidence, k: int) -> Calibration | None:
    """The calibration of k keypoints; None if too few frames show them.

    A keypoint's samples weigh n / (n + `SHRINKAGE`), n frames that show it, and those of all keypoints the rest: one
    without samples, such as a keypoint that was picked where nothing could be measured, is like the average one.
    """
    n_measured = len(np.unique(evidence.true_of))
    if not n_measured or len(evidence.true) < LEAST_SIGHTINGS * n_measured or not len(evidence.rival):
        return None
    each_true, each_rival = _shared(evidence.true_of), _shared(evidence.rival_of)
    alpha, tau_ratio = np.empty(k), np.empty(k)
    for i in range(k):
        own_true, own_rival = evidence.true_of == i, evidence.rival_of == i
        n_own = own_true.sum() if own_rival.any() else 0
        share = n_own / (n_own + SHRINKAGE)
        true_weight = share * own_true / max(own_true.sum(), 1) + (1 - share) * each_true
        rival_weight = share * own_rival / max(own_rival.sum(), 1) + (1 - share) * each_rival
        alpha[i], tau_ratio[i] = _fitted(evidence, true_weight, rival_weight)
    typical_off = np.array([np.average(off, weights=each_true) for off in evidence.off.T])
    return Calibration(alpha, tau_ratio, np.full(k, TEMPERATURES[int(typical_off.argmin())]))


def _fitted(
    evidence: Evidence, true_weight: Float[ndarray, "n"], rival_weight: Float[ndarray, "m"]
) -> tuple[float, float]:
    """alpha and tau over the mean likelihood, within their bounds.

    Where rivals match as well as the keypoint, a match cannot tell whether it is visible either, and tau between the
    two would let a visible track fade: whatever is hidden or out of view would win. There, tau is below the usual
    match, and depth and the image's border decide what is visible.
    """
    alpha, crossing = LEAST_ALPHA, 0.0
    bounds = {"least": LEAST_ALPHA, "most": TEMPERATURES[-1]}
    for _ in range(N_ROUNDS):
        true = evidence.true - _level(evidence.true_level, alpha)
        rival = evidence.rival - _level(evidence.rival_level, alpha)
        alpha, crossing = log_ratio(true, rival, true_weight, rival_weight, **bounds)
    # Below, a ratio is zero in single precision.
    least, log_ratio_of_tau = np.log(np.finfo(np.float32).tiny), -alpha * crossing
    if np.isclose(alpha, LEAST_ALPHA):
        above = evidence.true - _level(evidence.true_level, alpha)
        usual = -alpha * np.quantile(above, 0.5, weights=true_weight, method="inverted_cdf")
        log_ratio_of_tau = min(log_ratio_of_tau, usual + np.log(UNTOLD_TAU))
    return alpha, float(np.exp(np.clip(log_ratio_of_tau, least, np.log(MOST_TAU_RATIO))))


def _level(levels: Float[ndarray, "n a"], alpha: float) -> Float[ndarray, "n"]:
    """Levels at a temperature between those measured."""
    at = np.interp(np.log(alpha), np.log(TEMPERATURES), np.arange(len(TEMPERATURES)))
    below = min(int(at), len(TEMPERATURES) - 2)
    return levels[:, below] + (at - below) * (levels[:, below + 1] - levels[:, below])


def _shared(index: Int[ndarray, "n"]) -> Float[ndarray, "n"]:
    """Weights that sum to one, for each keypoint to the same."""
    own = np.bincount(index)
    return 1.0 / own[index] / (own > 0).sum()
