"""Agreement of a keypoint's matches: whether views find it at one place, and whether one view finds it at several.

Where the true place is known, a match has an error. In another scan it is not, but a static point has one place only:
views whose best matches, lifted by depth, lie there agree, and the others are wrong.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

NEAR = 0.02
"""Distance, metres, within which two matches are at one place, and a point counts as found: the tolerance of the
keypoint study. Chosen; sensitivity not measured."""

AWAY = 0.04
"""Distance, metres, from which on two places are different ones: twice `NEAR`, so that matches of one place are never
both. Chosen; sensitivity not measured."""

TIE = 0.05
"""Places match equally well if their descriptor distances differ by at most this share of the contrast, which is the
image's median distance less its smallest. A share, as networks differ in scale. Chosen on five simulated objects of
which the network confuses parts (decision 54): 0.02 misses most of what is symmetric, 0.1 also calls half of the points
of a crumpled paper ambiguous, 0.2 nearly everything."""


def agreed_place(matches: Float[ndarray, "v 3"], near: float = NEAR) -> tuple[Float[ndarray, "3"], int]:
    """The place where most views find a keypoint, and the number of these views.

    Args:
        matches: best match of each view, metres; NaN: none. All NaN gives a place of NaN.
        near: metres between a match and the others at its place.
    """
    known = matches[np.isfinite(matches).all(axis=1)]
    if len(known) == 0:
        return np.full(3, np.nan), 0
    apart = np.linalg.norm(known[:, None] - known[None], axis=-1)
    votes = (apart <= near).sum(axis=1)
    # Of equally many votes, those that lie closest together.
    best = np.lexsort((np.where(apart <= near, apart, 0.0).sum(axis=1), -votes))[0]
    return known[apart[best] <= near].mean(axis=0), int(votes[best])


def tied_distance(
    z: Float[ndarray, "h w"],
    points: Float[ndarray, "h w 3"],
    on_object: Bool[ndarray, "h w"],
    tie: float = TIE,
) -> float:
    """Distance, metres, from a view's best match on objects to the farthest place that matches equally well.

    Args:
        z: descriptor distance of every pixel to the keypoint.
        points: surface point of each pixel, metres; NaN: no depth.
        on_object: pixels that count: rivals off the objects are excluded by masks.
        tie: see `TIE`.

    Returns:
        NaN if no pixel counts.
    """
    counted = on_object & np.isfinite(points).all(axis=-1)
    if not counted.any():
        return float("nan")
    values, places = z[counted], points[counted]
    best = int(values.argmin())
    contrast = max(float(np.median(z)) - float(values[best]), 0.0)
    # What rounding adds to equal distances is less than a millionth.
    tied = values <= values[best] + tie * contrast + 1e-6
    return float(np.linalg.norm(places[tied] - places[best], axis=1).max())


@dataclass(frozen=True)
class Sightings:
    """What views of one static scene say about k keypoints.

    Args:
        error: distance of a view's best match from the place; NaN: the view does not show it.
        tied: distance to the farthest place that matches equally well; NaN: unknown.
    """

    error: Float[ndarray, "k v"]
    tied: Float[ndarray, "k v"]

    @property
    def n_views(self) -> Int[ndarray, "k"]:
        """Views that show each keypoint."""
        return np.isfinite(self.error).sum(axis=1)

    @property
    def n_found(self) -> Int[ndarray, "k"]:
        """Views that find each keypoint within `NEAR`."""
        return (self.error <= NEAR).sum(axis=1)

    @property
    def expected_error(self) -> Float[ndarray, "k"]:
        """Mean error of a view's best match, metres; NaN if no view shows the keypoint."""
        total = np.where(np.isfinite(self.error), self.error, 0.0).sum(axis=1)
        return np.where(self.n_views > 0, total / np.maximum(self.n_views, 1), np.nan)

    @property
    def is_ambiguous(self) -> Bool[ndarray, "k"]:
        """Whether at least half of the views find each keypoint at several places, equally well."""
        known = np.isfinite(self.tied)
        away = known & (np.where(known, self.tied, 0.0) >= AWAY)
        return known.any(axis=1) & (2 * away.sum(axis=1) >= known.sum(axis=1))


def joined(parts: list[Sightings], n: int) -> Sightings:
    """Sightings of the same n keypoints in all views of several scenes."""
    none = np.empty((n, 0))
    return Sightings(
        np.concatenate([none, *(part.error for part in parts)], axis=1),
        np.concatenate([none, *(part.tied for part in parts)], axis=1),
    )


def sightings_of(
    matches: Float[ndarray, "k v 3"],
    shown: Bool[ndarray, "k v"],
    tied: Float[ndarray, "k v"],
    places: Float[ndarray, "k 3"],
) -> Sightings:
    """Sightings from the views' best matches.

    Args:
        matches: metres; NaN: the best match has no depth, which counts as wrong by as much as the worst match.
        shown: views that show `places`.
        places: the keypoints' true or agreed places, metres; NaN: none.
    """
    error = np.linalg.norm(matches - places[:, None], axis=-1)
    unknown = shown & ~np.isfinite(error)
    worst = np.nanmax(np.where(shown, error, np.nan), initial=0.0)
    return Sightings(np.where(shown, np.where(unknown, worst, error), np.nan), np.where(shown, tied, np.nan))
