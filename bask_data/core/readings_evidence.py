"""Evidence of many hypotheses about a camera's recording, pair of frames by pair of frames."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from bask_data.core.geometry import invert_rigid
from bask_data.core.warped_depth import TOLERANCES, DepthView, Warps, evidence_of

AT_REST = -1
"""In place of a reading: the camera did not move."""

NO_TRANSLATION = np.inf
"""A scale: the camera only turned."""

N_NOISE_VIEWS = 8
"""Frames that the noise of depth is estimated from. Sensitivity not measured."""


class Trial(NamedTuple):
    """A hypothesis in the terms of the search.

    Args:
        reading: which of the readings of the poses, or `AT_REST`.
        scale: how much larger depth is in comparison with the poses.
        K_factor, lag: as in `Hypothesis`.
        ray: as in `Warps`.
    """

    reading: int
    scale: float = 1.0
    K_factor: tuple[float, float] = (1.0, 1.0)
    lag: int = 0
    ray: int = 0


class PairedViews:
    """Depth of a camera's frames in pairs, with its poses under some readings.

    Args:
        views: by frame.
        pairs: frames a and b.
        readings: world_from_cameras of all frames under each reading.
        lags: all that trials may have.
    """

    def __init__(
        self,
        views: dict[int, DepthView],
        pairs: Sequence[tuple[int, int]],
        readings: Sequence[Float[ndarray, "t 4 4"]],
        lags: Sequence[int],
    ) -> None:
        self.pairs, self._views, self._lags = list(pairs), views, {lag: i for i, lag in enumerate(lags)}
        a, b = np.array(self.pairs).T
        moves = []
        for poses in readings:
            for lag in lags:
                shifted = poses[np.clip(np.arange(len(poses)) + lag, 0, len(poses) - 1)]
                moves.append(invert_rigid(shifted[b]) @ shifted[a])
        moves.append(np.broadcast_to(np.eye(4), (len(self.pairs), 4, 4)))
        self._moves = np.stack(moves, axis=1)

    def move(self, trial: Trial) -> Float[ndarray, "p 4 4"]:
        """Motion of the camera between the frames of each pair, b_from_a, in the poses' metres."""
        return self._moves[:, self._row(trial)]

    def median_depth(self) -> float:
        """Metres as read; 0 if nothing was measured."""
        depths = [view.z for view in self._views.values() if len(view.z)]
        return float(np.median(np.concatenate(depths))) if depths else 0.0

    def ceiling(self) -> float:
        """Evidence that the noise of depth allows at most, from how far pixels lie off their neighbours in a row. It is
        too high where noise is alike in neighbours, as that of most cameras is."""
        shares = []
        for view in list(self._views.values())[:: max(1, len(self._views) // N_NOISE_VIEWS)]:
            left, middle, right = view.depth[:, :-2], view.depth[:, 1:-1], view.depth[:, 2:]
            known = (left > 0) & (middle > 0) & (right > 0)
            # Two depths differ by sqrt(2) of the noise, this sum by sqrt(6).
            off = np.abs(left + right - 2 * middle)[known] / (np.sqrt(3) * middle[known])
            shares += [float((off < tolerance).mean()) for tolerance in TOLERANCES] if len(off) else []
        return float(np.mean(shares)) if shares else 1.0

    def scores(
        self, trials: Sequence[Trial], chosen: Sequence[int] | None = None, step: int = 1
    ) -> tuple[Float[ndarray, "h p"], Float[ndarray, "h p"]]:
        """Evidence of each trial and pair, and the share of points that fell onto measured depth.

        Args:
            chosen: which pairs; all unless given.
            step: every so many points only.
        """
        warps = Warps(
            np.array([self._row(trial) for trial in trials], np.int64),
            np.array([1 / trial.scale for trial in trials], np.float64),
            np.array([trial.K_factor for trial in trials], np.float64).reshape(-1, 2),
            np.array([trial.ray for trial in trials], np.int64),
        )
        indices = range(len(self.pairs)) if chosen is None else chosen
        found = []
        for i in indices:
            a, b = self.pairs[i]
            found.append(evidence_of(self._views[a].thinned(step), self._views[b], self._moves[i], warps))
        met, seen = np.array([each[0] for each in found]).T, np.array([each[1] for each in found]).T
        return met, seen

    def _row(self, trial: Trial) -> int:
        if trial.reading == AT_REST:
            return int(self._moves.shape[1]) - 1
        return trial.reading * len(self._lags) + self._lags[trial.lag]
