"""Errors of keypoint tracks, by what the cameras see of the points, and over time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

MOVING = 0.001
"""Metres in one frame from which a point counts as moving. Assumes a tabletop. Chosen, sensitivity not measured."""
RETURNING = 5
"""Number of frames in which a point counts as returning, after at least as many in which it was not visible. Chosen,
sensitivity not measured."""
CLOSE = 0.02
"""Metres from ground truth within which an estimate counts as close. Assumes a tabletop."""
PHASES = ("visible", "occluded", "out of view", "not seen yet", "returning", "moving", "still")
"""Classes of frames. The first four exclude each other, and so do the last two. A point that no camera has seen yet
cannot be known: it is neither occluded nor out of view."""


@dataclass(frozen=True)
class Sighting:
    """States of k keypoints in t frames, for all cameras together; none where the position is unknown.

    Attributes:
        visible: some camera shows it.
        occluded: it is inside some images, and hidden in all of these.
        out_of_view: it is in no image.
    """

    visible: Bool[ndarray, "t k"]
    occluded: Bool[ndarray, "t k"]
    out_of_view: Bool[ndarray, "t k"]


def sighting(
    inside: Bool[ndarray, "c t k"], hidden: Bool[ndarray, "c t k"], places: Float[ndarray, "t k 3"]
) -> Sighting:
    """States of keypoints for all cameras together.

    Args:
        inside: whether the point is inside each camera's image.
        hidden: whether an occluder is in front of it there.
        places: true positions, metres; NaN where unknown.
    """
    known = np.isfinite(places).all(axis=2)
    visible, in_some = (inside & ~hidden).any(axis=0), inside.any(axis=0)
    return Sighting(known & visible, known & in_some & ~visible, known & ~in_some)


def phases(places: Float[ndarray, "t k 3"], seen: Sighting) -> dict[str, Bool[ndarray, "t k"]]:
    """Frames in each of `PHASES`, by keypoint."""
    known, moves = np.isfinite(places).all(axis=2), moving(places)
    seen_before = np.logical_or.accumulate(seen.visible, axis=0)
    return {
        "visible": seen.visible,
        "occluded": seen.occluded & seen_before,
        "out of view": seen.out_of_view & seen_before,
        "not seen yet": known & ~seen_before,
        "returning": returning(seen.visible),
        "moving": known & moves,
        "still": known & ~moves,
    }


def moving(places: Float[ndarray, "t k 3"], least: float = MOVING) -> Bool[ndarray, "t k"]:
    """Whether a point has moved by at least so many metres since the previous frame; False where unknown."""
    step = np.linalg.norm(np.diff(places, axis=0, prepend=places[:1]), axis=2)
    return np.nan_to_num(step) >= least


def returning(visible: Bool[ndarray, "t k"], n: int = RETURNING) -> Bool[ndarray, "t k"]:
    """The first n frames in which a point is visible again, after it was seen once and then not for n frames or more.

    Frames among these in which it is hidden again do not count.
    """
    result = np.zeros(visible.shape, dtype=bool)
    lost = np.zeros(visible.shape[1], dtype=int)
    since = np.full(visible.shape[1], n)
    ever = np.zeros(visible.shape[1], dtype=bool)
    for now, shown in zip(result, visible, strict=True):
        comes_back = shown & ever & (lost >= n)
        since = np.where(comes_back, 0, since + 1)
        now[:] = shown & (since < n)
        lost = np.where(shown, 0, lost + 1)
        ever |= shown
    return result


def distances(a: Float[ndarray, "t k 3"], b: Float[ndarray, "t k 3"]) -> Float[ndarray, "t k"]:
    """Distance between two positions of each keypoint and frame, metres; NaN where either is unknown."""
    return np.linalg.norm(a.astype(np.float64) - b.astype(np.float64), axis=2)


@dataclass(frozen=True)
class Errors:
    """Statistics of the distances of many frames and keypoints, metres; NaN where there are none.

    Attributes:
        n: number of known distances.
        n_unknown: number of frames and keypoints without an estimate.
        deviation: standard deviation of the means of single tracks: how much keypoints and demonstrations differ.
        close: share of all, including those without an estimate, within `CLOSE`.
    """

    n: int
    n_unknown: int
    mean: float
    deviation: float
    median: float
    p90: float
    close: float


def errors(tracks: Sequence[Float[ndarray, "_ _"]], chosen: Sequence[Bool[ndarray, "_ _"]]) -> Errors:
    """Statistics over the chosen frames and keypoints of several recordings, whose t and k may differ."""
    values = np.concatenate([np.zeros(0), *(track[mask] for track, mask in zip(tracks, chosen, strict=True))])
    known = np.isfinite(values)
    nothing = np.nan
    if not known.any():
        return Errors(0, len(values), nothing, nothing, nothing, nothing, 0.0 if len(values) else nothing)
    of_tracks = np.concatenate([_means(track, mask) for track, mask in zip(tracks, chosen, strict=True)])
    finite = values[known]
    return Errors(
        n=len(finite),
        n_unknown=int((~known).sum()),
        mean=float(finite.mean()),
        deviation=float(of_tracks[np.isfinite(of_tracks)].std()),
        median=float(np.median(finite)),
        p90=float(np.percentile(finite, 90)),
        close=float((finite < CLOSE).sum() / len(values)),
    )


def _means(track: Float[ndarray, "t k"], chosen: Bool[ndarray, "t k"]) -> Float[ndarray, "k"]:
    """Mean of each keypoint over the chosen frames with a known distance; NaN without any."""
    counted = chosen & np.isfinite(track)
    n = counted.sum(axis=0)
    return np.where(n > 0, np.where(counted, track, 0.0).sum(axis=0) / np.maximum(n, 1), np.nan)


@dataclass(frozen=True)
class OverTime:
    """Mean and standard deviation over keypoints and recordings at n times, evenly from first to last frame."""

    mean: Float[ndarray, "n"]
    deviation: Float[ndarray, "n"]


def over_time(tracks: Sequence[Float[ndarray, "_ _"]], n: int) -> OverTime:
    """Statistics of recordings of any length, aligned from first to last frame; NaN where nothing is known.

    Each time takes the nearest frame, because there is nothing between a frame that sees a point and one that does not.
    """
    aligned = np.concatenate([track[np.linspace(0, len(track) - 1, n).round().astype(int)] for track in tracks], axis=1)
    known = np.isfinite(aligned)
    count = known.sum(axis=1)
    mean = np.where(known, aligned, 0.0).sum(axis=1) / np.maximum(count, 1)
    variance = np.where(known, (aligned - mean[:, None]) ** 2, 0.0).sum(axis=1) / np.maximum(count, 1)
    return OverTime(np.where(count > 0, mean, np.nan), np.where(count > 0, np.sqrt(variance), np.nan))


def share_over_time(phase: Sequence[Bool[ndarray, "_ _"]], n: int) -> Float[ndarray, "n"]:
    """Share of the keypoints of all recordings that are in a phase, at n times from first to last frame."""
    return over_time([is_in.astype(np.float64) for is_in in phase], n).mean


def z_edges(least: float = 0.01, most: float = 30.0, n: int = 70) -> Float[ndarray, "n_plus_1"]:
    """Edges of n bins of descriptor distance, evenly spaced in its logarithm."""
    return np.geomspace(least, most, n + 1)


def z_counts(
    distance: Float[ndarray, "k h w"], groups: Mapping[str, Bool[ndarray, "k h w"]], edges: Float[ndarray, "m"]
) -> dict[str, Int[ndarray, "n"]]:
    """Histogram of the distances in each group of pixels; the first and last bin include what is beyond the edges."""
    i_bin = np.searchsorted(edges, distance, side="right") - 1
    i_bin = i_bin.clip(0, len(edges) - 2)
    return {name: np.bincount(i_bin[group], minlength=len(edges) - 1) for name, group in groups.items()}
