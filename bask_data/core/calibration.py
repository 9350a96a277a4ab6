"""Temperature and tau of each keypoint, measured: what a descriptor distance tells of where a keypoint is.

A filter compares positions: the track, positions that matched in some other frame, and *not visible*. A frame's part in
that comparison is exp(-alpha z) / tau, an estimate of the likelihood ratio f_true(z) / f_rival(z): z is distributed as
f_true at the keypoint, and as f_rival at its rivals, the positions that matched best in another frame. Both are
followed to other frames, from near and from far. So a rival that deceives a network in ten frames in a row counts as
what it is, one error seen ten times, and alpha needs no further correction for the correlation of successive frames.
"""

from __future__ import annotations

from dataclasses import dataclass

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

SHARP_ALPHAS = (4.0, 8.0, 16.0, 32.0, 64.0)
"""Temperatures tried for single frames."""


@dataclass(frozen=True)
class Calibration:
    """What distances of k keypoints are worth to the filters.

    Attributes:
        alpha: temperature over many frames: a pixel at distance z has likelihood exp(-alpha z).
        tau: likelihood of an image that does not show the keypoint.
        sharp_alpha: temperature of a single frame's heat map, whose mean pixel is nearest to the keypoint.
    """

    alpha: Float[ndarray, "k"]
    tau: Float[ndarray, "k"]
    sharp_alpha: Float[ndarray, "k"]

    @property
    def crossing(self) -> Float[ndarray, "k"]:
        """Distance at which a match is as likely at a rival as at the keypoint."""
        return -np.log(self.tau) / self.alpha


@dataclass(frozen=True)
class Evidence:
    """Descriptor distances at keypoints and at their rivals, in frames in which these are visible.

    Attributes:
        true: distance at the keypoint, in frames other than that of the pick.
        true_of: index of its keypoint.
        rival: distance at a rival, in frames other than that in which it matched best.
        rival_of: index of its keypoint.
        off: for each of `true` and of the temperatures `SHARP_ALPHAS`, distance of the heat map's mean pixel from the
            keypoint, as a share of the image's diagonal.
    """

    true: Float[ndarray, "n"]
    true_of: Int[ndarray, "n"]
    rival: Float[ndarray, "m"]
    rival_of: Int[ndarray, "m"]
    off: Float[ndarray, "n a"]


def calibrated(evidence: Evidence, k: int) -> Calibration | None:
    """The calibration of k keypoints; None if too few frames show them.

    A keypoint's samples weigh n / (n + `SHRINKAGE`), n frames that show it, and those of all keypoints the rest: one
    without samples, such as a keypoint that was picked where nothing could be measured, is like the average one.
    """
    n_measured = len(np.unique(evidence.true_of))
    if not n_measured or len(evidence.true) < LEAST_SIGHTINGS * n_measured or not len(evidence.rival):
        return None
    each_true = _shared(evidence.true_of)
    each_rival = _shared(evidence.rival_of)
    alpha, crossing = np.empty(k), np.empty(k)
    for i in range(k):
        own_true, own_rival = evidence.true_of == i, evidence.rival_of == i
        n_own = own_true.sum() if own_rival.any() else 0
        share = n_own / (n_own + SHRINKAGE)
        true_weight = share * own_true / max(own_true.sum(), 1) + (1 - share) * each_true
        rival_weight = share * own_rival / max(own_rival.sum(), 1) + (1 - share) * each_rival
        alpha[i], crossing[i] = log_ratio(evidence.true, evidence.rival, true_weight, rival_weight)
    typical_off = np.array([np.average(off, weights=each_true) for off in evidence.off.T])
    sharp = np.full(k, SHARP_ALPHAS[int(typical_off.argmin())])
    return Calibration(alpha, np.exp(-alpha * crossing), sharp)


def _shared(index: Int[ndarray, "n"]) -> Float[ndarray, "n"]:
    """Weights that sum to one, for each keypoint to the same."""
    own = np.bincount(index)
    return 1.0 / own[index] / (own > 0).sum()
