"""Whether two objects seen in different scans are the same one: what differs between them, and the odds by that."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from bask_data.core.identity_colour import LIGHT_DISCOUNT, chroma_distances, lightness_distances

EVIDENCE = ("colour", "appearance", "size")
"""What is compared, in the order of `differences`."""
BIAS, WEIGHTS = 12.8, (17.7, 41.5, 24.4)
"""Log odds of objects without any difference, and what a unit of each difference takes off: a logistic regression on
15 228 pairs of 44 objects in 16 simulated scans (tasks drawer and mug, seeds 101 and 102), each also under another
light and seen from one side only. benchmarks/identity_scores.py measures on other tasks and seeds. Sensitivity not
measured."""
N_BOX_POINTS = 4000
"""Points of a surface that its box is computed from. Does not change the result by more than their spacing."""
TRIMMED = 0.01
"""Share of the surface beyond either face of the oriented box: flying points of a mesh. Chosen, sensitivity not
measured."""


@dataclass(frozen=True)
class ObjectLook:
    """An object as seen in one scan.

    Args:
        extents: edges of its oriented box, the longest first, metres.
        colours: histograms of `identity_colour`, one for each view.
        appearances: unit vectors of a network's features, one for each view.
    """

    extents: Float[ndarray, "3"]
    colours: Float[ndarray, "v b"]
    appearances: Float[ndarray, "v d"]


def differences(a: ObjectLook, b: ObjectLook) -> Float[ndarray, "3"]:
    """What differs between two objects, each at least 0 and 0 for the same look; in the order of `EVIDENCE`."""
    chroma = between_views(chroma_distances(a.colours, b.colours))
    lightness = between_views(lightness_distances(a.colours, b.colours))
    # Of an object seen from one side, the shortest edge is missing.
    edges = np.abs(np.log(a.extents[:2] / b.extents[:2]))
    return np.array(
        [
            chroma / (1 + LIGHT_DISCOUNT * lightness),
            between_views(1.0 - a.appearances @ b.appearances.T),
            edges.mean(),
        ]
    )


def between_views(distances: Float[ndarray, "v w"]) -> float:
    """Mean distance of each view of either object from the most similar one of the other.

    Two scans show an object from different sides, so that views are not comparable one by one.
    """
    return float((distances.min(axis=0).mean() + distances.min(axis=1).mean()) / 2)


def all_differences(looks: Sequence[ObjectLook]) -> Float[ndarray, "n n 3"]:
    """`differences` of all pairs, symmetric."""
    found = np.zeros((len(looks), len(looks), len(EVIDENCE)))
    for i, one in enumerate(looks):
        for j in range(i):
            found[i, j] = found[j, i] = differences(one, looks[j])
    return found


def log_odds_of(found: Float[ndarray, "*n 3"]) -> Float[ndarray, "*n"]:
    """Logarithm of how much likelier such differences are between views of one object than of two.

    Both were equally frequent where the weights were fitted, so that the prior odds have to be added.
    """
    return BIAS - found @ np.array(WEIGHTS)


def oriented_extents(points: Float[ndarray, "n 3"], areas: Float[ndarray, "n"]) -> Float[ndarray, "3"]:
    """Edges of the box of a surface along its principal axes, the longest first, metres.

    Args:
        points: vertices, metres, any frame.
        areas: square metres that each vertex represents.

    Raises:
        ValueError: no point has an area, or all lie on a line.
    """
    total = np.cumsum(areas)
    if not len(total) or total[-1] <= 0:
        raise ValueError("expected points with an area, got none")
    # Vertices are not evenly spread over a mesh; sampled evenly by area, points are, and no chance is needed.
    chosen = np.searchsorted(total, (np.arange(N_BOX_POINTS) + 0.5) / N_BOX_POINTS * total[-1])
    centred = points[chosen] - points[chosen].mean(axis=0)
    axes = np.linalg.eigh(centred.T @ centred)[1]
    low, high = np.quantile(centred @ axes, (TRIMMED, 1 - TRIMMED), axis=0)
    extents = np.sort(high - low)[::-1]
    if extents[1] <= 0:
        raise ValueError(f"expected points that span a surface, got edges of {extents.tolist()} metres")
    return extents
