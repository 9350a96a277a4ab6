"""Accuracy of descriptors: figures of their matches, cumulative curves, and the calibration of heat maps.

A query is a pixel of one view; its true match is a position in another view. It is compared with the best match, the
pixel of the other view whose descriptor is closest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

PERCENTS = (1, 2, 4, 8)
"""Thresholds of PCK, percent of the image's diagonal."""
N_CURVE = 101
"""Number of points of a cumulative curve."""
LIMITS = {"error_share": 1.0, "error_3d": 0.1, "closer_share": 1.0, "false_positive_share": 1.0}
"""By metric, the end of its cumulative curve: the diagonal, ten centimetres (assumes a tabletop), the whole image."""


@dataclass(frozen=True)
class MapScores:
    """Figures of n distance maps of one image, one for each query. Lengths are in pixels of the image.

    Attributes:
        best: (u, v) of the smallest distance.
        expected: (u, v) of the heat map's mean.
        error_px: from the best match to the true one.
        closer_share: share of the image's pixels whose distance is smaller than that at the true match.
        false_positive_px: mean distance of those pixels from the true match; 0 if there are none.
        confidence: share of the heat map within the radius of the best match, for each temperature.
    """

    best: Float[ndarray, "n 2"]
    expected: Float[ndarray, "n 2"]
    error_px: Float[ndarray, " n"]
    closer_share: Float[ndarray, " n"]
    false_positive_px: Float[ndarray, " n"]
    confidence: Float[ndarray, "n a"]


def map_scores(
    distance: Float[ndarray, "n h w"],
    at_truth: Float[ndarray, " n"],
    true_uv: Float[ndarray, "n 2"],
    size: tuple[int, int],
    alphas: Sequence[float],
    radius_px: float,
) -> MapScores:
    """Compare distance maps with the true matches.

    Args:
        distance: descriptor distance z; a map spans the image edge to edge and may be coarser or finer.
        at_truth: descriptor distance at the true match, interpolated between pixels.
        true_uv: pixels of the image.
        size: (height, width) of the image.
        alphas: temperatures of heat maps softmax(-alpha z); the first gives `expected`.
        radius_px: of the confidence, pixels of the image.

    Source of `closer_share` and `false_positive_px`: Florence et al. 2018, Sec. 5.1.
    """
    n, height, width = distance.shape
    u = (np.arange(width) + 0.5) * size[1] / width - 0.5
    v = (np.arange(height) + 0.5) * size[0] / height - 0.5
    best, expected = np.empty((n, 2)), np.empty((n, 2))
    closer_share, false_positive_px, confidence = np.empty(n), np.empty(n), np.empty((n, len(alphas)))
    for i, z in enumerate(distance):
        row, column = divmod(int(z.argmin()), width)
        best[i] = u[column], v[row]
        heats = [np.exp(-alpha * (z - z[row, column])) for alpha in alphas]
        mass = heats[0].astype(np.float64) / heats[0].sum(dtype=np.float64)
        expected[i] = mass.sum(axis=0) @ u, mass.sum(axis=1) @ v
        confidence[i] = [_within(heat, u, v, best[i], radius_px) / heat.sum(dtype=np.float64) for heat in heats]
        rows, columns = np.nonzero(z < at_truth[i])
        closer_share[i] = len(rows) / z.size
        away = np.hypot(u[columns] - true_uv[i, 0], v[rows] - true_uv[i, 1])
        false_positive_px[i] = away.mean() if len(away) else 0.0
    error_px = np.linalg.norm(best - true_uv, axis=1)
    return MapScores(best, expected, error_px, closer_share, false_positive_px, confidence)


def _within(
    heat: Float[ndarray, "h w"],
    u: Float[ndarray, " w"],
    v: Float[ndarray, " h"],
    centre: Float[ndarray, "2"],
    radius: float,
) -> float:
    """Total heat of the pixels within a radius of the centre."""
    columns, rows = np.flatnonzero(np.abs(u - centre[0]) <= radius), np.flatnonzero(np.abs(v - centre[1]) <= radius)
    window = heat[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    near = np.hypot(u[columns] - centre[0], (v[rows] - centre[1])[:, None]) <= radius
    return float(window[near].sum(dtype=np.float64))


@dataclass(frozen=True)
class Records:
    """Figures of n matches, each for itself.

    Attributes:
        error_px: from the best match to the true one, pixels of the image.
        error_share: the same as a share of the image's diagonal.
        error_3d: metres between the surface at the best match and the true point; NaN without depth.
        closer_share: share of the image's pixels whose descriptors are closer to the query's than the true match's.
        false_positive_px: mean distance of those pixels from the true match, pixels of the image.
        false_positive_share: the same as a share of the image's diagonal.
        confidence: share of the heat map within a radius of the best match, for each temperature.
        is_near: whether the true match is within that radius.
    """

    error_px: Float[ndarray, " n"]
    error_share: Float[ndarray, " n"]
    error_3d: Float[ndarray, " n"]
    closer_share: Float[ndarray, " n"]
    false_positive_px: Float[ndarray, " n"]
    false_positive_share: Float[ndarray, " n"]
    confidence: Float[ndarray, "n a"]
    is_near: Bool[ndarray, " n"]

    def __len__(self) -> int:
        return len(self.error_px)

    def chosen(self, which: Bool[ndarray, " n"]) -> Records:
        """The chosen matches."""
        return Records(**{name: values[which] for name, values in vars(self).items()})

    @staticmethod
    def joined(parts: Sequence[Records]) -> Records:
        """The matches of all parts."""
        if not parts:
            empty = np.zeros(0)
            return Records(empty, empty, empty, empty, empty, empty, np.zeros((0, 0)), empty > 0)
        return Records(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in vars(parts[0])})


def figures(records: Records) -> dict[str, float | int | None]:
    """Figures over several matches as plain numbers; None where there is no match to compute them from.

    `pck_4` is the share within 4 % of the image's diagonal. `area_...` is the area above the cumulative curve of a
    metric, from 0 to its limit, as a share of the whole: 0 is perfect.
    """
    n = len(records)
    known = records.error_3d[np.isfinite(records.error_3d)]
    result: dict[str, float | int | None] = {"n": n, "n_3d": len(known)}
    result["median_px"] = _figure(np.median, records.error_px)
    for percent in PERCENTS:
        result[f"pck_{percent}"] = _figure(np.mean, records.error_share <= percent / 100)
    result["median_3d_m"] = _figure(np.median, known)
    result["closer_mean"] = _figure(np.mean, records.closer_share)
    result["closer_median"] = _figure(np.median, records.closer_share)
    result["false_positive_px"] = _figure(np.mean, records.false_positive_px)
    result["false_positive_share"] = _figure(np.mean, records.false_positive_share)
    for name, limit in LIMITS.items():
        result[f"area_{name}"] = area_above(getattr(records, name), limit)
    return result


def _figure(of: object, values: ndarray) -> float | None:
    return float(of(values)) if len(values) else None  # type: ignore[operator]


def area_above(values: Float[ndarray, " n"], limit: float) -> float | None:
    """Area above the cumulative curve of values >= 0 between 0 and the limit, divided by the limit; NaN is ignored.

    It equals the mean of the values, clipped at the limit.
    """
    known = values[~np.isnan(values)]
    return _figure(np.mean, np.minimum(known, limit) / limit)


def cumulative(values: Float[ndarray, " n"], limit: float) -> tuple[Float[ndarray, " x"], Float[ndarray, " x"]]:
    """Thresholds from 0 to the limit, denser near 0, and the share of values up to each; NaN is ignored."""
    known = np.sort(values[~np.isnan(values)])
    thresholds = limit * np.linspace(0, 1, N_CURVE) ** 2
    below = np.searchsorted(known, thresholds, side="right")
    return thresholds, below / len(known) if len(known) else np.full(N_CURVE, np.nan)


@dataclass(frozen=True)
class Reliability:
    """A reliability diagram of heat maps: accuracy by confidence, in bins of equal width.

    Attributes:
        n: matches in each bin.
        confidence: their mean; NaN in an empty bin.
        accuracy: share of them whose true match is near the best one; NaN in an empty bin.
    """

    n: Int[ndarray, " bins"]
    confidence: Float[ndarray, " bins"]
    accuracy: Float[ndarray, " bins"]

    @property
    def error(self) -> float:
        """Expected calibration error: the mean gap between confidence and accuracy, weighted by the number of matches
        in each bin; NaN without matches.

        Source: Guo et al. 2017, On Calibration of Modern Neural Networks, Eq. 3.
        """
        if not self.n.sum():
            return float("nan")
        gap = np.abs(np.nan_to_num(self.confidence) - np.nan_to_num(self.accuracy))
        return float(self.n @ gap / self.n.sum())


def reliability(confidence: Float[ndarray, " n"], is_near: Bool[ndarray, " n"], n_bins: int = 10) -> Reliability:
    """The calibration of heat maps: their confidence compared with how often the true match is near."""
    i_bin = np.minimum((confidence * n_bins).astype(np.int64), n_bins - 1)
    n = np.bincount(i_bin, minlength=n_bins)
    sums = (np.bincount(i_bin, weights=values, minlength=n_bins) for values in (confidence, is_near.astype(float)))
    confidence_mean, accuracy = (np.where(n > 0, total / np.maximum(n, 1), np.nan) for total in sums)
    return Reliability(n, confidence_mean, accuracy)


def filling(counts: Int[ndarray, "p s"], chosen: Sequence[int], n: int, rng: np.random.Generator) -> list[int]:
    """At most n rows, chosen so that their sums become as equal over the columns as possible.

    The next row is drawn in proportion to its count in the column with the lowest sum.

    Args:
        counts: of each row in each column.
        chosen: rows already chosen; they come first.
    """
    chosen, free = list(chosen), np.ones(len(counts), bool)
    free[chosen] = False
    sums = counts[chosen].sum(axis=0)
    while len(chosen) < n and free.any():
        fillable = (counts[free] > 0).any(axis=0)
        if not fillable.any():
            break
        column = int(np.argmin(np.where(fillable, sums, np.iinfo(np.int64).max)))
        weight = counts[:, column] * free
        row = int(rng.choice(len(counts), p=weight / weight.sum()))
        chosen.append(row)
        free[row] = False
        sums = sums + counts[row]
    return chosen
