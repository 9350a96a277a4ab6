"""Parts of one object that an occluder, or the object's own rim, divides in all views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy.spatial import ConvexHull, QhullError, cKDTree

from bask_data.core.sightings import PosedDepth, sighted

N_PART_POINTS = 300
"""Most points of a part that are compared with another's. Chosen to bound time, sensitivity not measured."""
SMOOTHED = 0.015
"""Metres around a point over which its normal is averaged. Assumes a tabletop. Chosen, sensitivity not measured."""
GOES_ON_FACING = np.cos(np.deg2rad(15.0))
"""Cosine of the angle between the normals of a surface that goes on behind an occluder; smaller for one that curves
around the gap's direction, which this allows. Chosen, sensitivity not measured."""
OFF_SURFACE = (0.004, 0.05)
"""(a, b): the surface goes on if it is met within a + b times the gap, metres: noise, and that of the normals. Chosen,
sensitivity not measured."""
CONTINUED_SHARE = 0.2
"""Least share of each part whose surface goes on in the other. Ends and faces that only one part shows do not. Chosen
on five single views of stacked boxes (0.22 to 0.74 between parts of one object, at most 0.1 between objects)."""
HIDDEN_SHARE = 0.3
"""Least share of a gap that must be hidden; beside an occluder, depth cameras measure nothing. Chosen, sensitivity not
measured."""
STEPS = np.linspace(0.1, 0.9, 9)
"""Where gaps are looked at, from one end to the other."""
FILLED = 2.0
"""Largest volume of the convex hull of two parts over the sum of theirs for one to be the inside of the other: the
halves of a bowl add up to it, of which only some is seen; distant parts have the gap besides. Chosen, sensitivity not
measured."""
RIM = 0.015
"""Metres by which the rim of a vessel may be higher on one side. Assumes a tabletop. Chosen, sensitivity not measured.
"""
INWARD_SHARE = 0.7
"""Least share of a part's surface that faces its own middle for it to be the inside of something. Chosen, sensitivity
not measured."""


@dataclass(frozen=True)
class SampledPart:
    """Sampled surface of a part: points, smoothed unit normals, and its convex hull's volume."""

    points: Float[ndarray, "n 3"]
    normals: Float[ndarray, "n 3"]
    volume: float


@dataclass(frozen=True)
class PartsSettings:
    """Settings of the joining.

    Args:
        reach: metres between a rim and the inside behind it.
        max_extent: metres; parts are not joined to something longer.
    """

    reach: float
    max_extent: float


def with_joined_parts(
    labels: Int[ndarray, "n"],
    vertices: Float[ndarray, "n 3"],
    normals: Float[ndarray, "n 3"],
    views: Sequence[PosedDepth],
    up: Float[ndarray, "3"],
    settings: PartsSettings,
) -> Int[ndarray, "n"]:
    """Labels in which the parts of an object that is divided in all views have one.

    Two parts are one if nothing was seen between them, and the surface of each goes on in the other; or if one is the
    inside of the other, whose rim hides the rest.

    Args:
        up: unit normal of the support.
    """
    numbers = np.unique(labels[labels > 0])
    parts = {int(i): part_of(vertices[labels == i].astype(np.float64), normals[labels == i]) for i in numbers}
    root = {i: i for i in parts}
    for i, j in combinations(parts, 2):
        a, b = parts[i], parts[j]
        both = np.concatenate([a.points, b.points])
        if np.ptp(both, axis=0).max() > settings.max_extent:
            continue
        if is_inside(a, b, up, settings.reach) or is_inside(b, a, up, settings.reach) or goes_on(a, b, views):
            old, new = max(root[i], root[j]), min(root[i], root[j])
            root = {k: new if k_root == old else k_root for k, k_root in root.items()}
    joined = np.arange(int(labels.max(initial=0)) + 1)
    for i, i_root in root.items():
        joined[i] = i_root
    return joined[labels]


def part_of(points: Float[ndarray, "n 3"], normals: Float[ndarray, "n 3"]) -> SampledPart:
    """A sample of a part, with normals averaged over the surface around."""
    chosen = np.unique(np.linspace(0, len(points) - 1, N_PART_POINTS).round().astype(int))
    tree = cKDTree(points)
    smooth = np.array([normals[near].sum(axis=0) for near in tree.query_ball_point(points[chosen], SMOOTHED)])
    length = np.linalg.norm(smooth, axis=1, keepdims=True)
    unit = np.divide(smooth, length, out=np.zeros_like(smooth), where=length > 0)
    return SampledPart(points[chosen], unit.astype(np.float64), hull_volume(points[chosen]))


def hull_volume(points: Float[ndarray, "n 3"]) -> float:
    """Cubic metres of the convex hull; 0 of flat points."""
    try:
        return float(ConvexHull(points).volume)
    except (QhullError, ValueError):
        return 0.0


def is_inside(inner: SampledPart, outer: SampledPart, up: Float[ndarray, "3"], reach: float) -> bool:
    """Whether a part is the inside of a vessel whose outside is the other: it faces its own middle, both have a rim at
    the same height, and together they fill their hull."""
    towards = inner.points.mean(axis=0) - inner.points
    if (np.einsum("ij,ij->i", towards, inner.normals) > 0).mean() < INWARD_SHARE:
        return False
    if cKDTree(outer.points).query(inner.points)[0].min() > reach:
        return False
    rims = [float(np.percentile(part.points @ up, 98)) for part in (inner, outer)]
    if abs(rims[0] - rims[1]) > RIM:
        return False
    whole = hull_volume(np.concatenate([inner.points, outer.points]))
    return whole <= FILLED * (inner.volume + outer.volume)


def goes_on(a: SampledPart, b: SampledPart, views: Sequence[PosedDepth]) -> bool:
    """Whether the surface of each part goes on in the other, behind what hides the gap between them."""
    if not views:
        return False
    gap = b.points[None] - a.points[:, None]
    length = np.linalg.norm(gap, axis=-1)
    near = length < length.min() + 2 * SMOOTHED
    hidden = near.copy()
    hidden[near] = gaps_hidden(a.points[np.nonzero(near)[0]], b.points[np.nonzero(near)[1]], views)
    if hidden.sum() < 0.5 * near.sum():
        return False
    allowed = OFF_SURFACE[0] + OFF_SURFACE[1] * length
    level = np.abs(np.einsum("ijk,ik->ij", gap, a.normals)) < allowed
    level &= np.abs(np.einsum("ijk,jk->ij", gap, b.normals)) < allowed
    level &= a.normals @ b.normals.T > GOES_ON_FACING
    i, j = np.nonzero(level)
    clear = gaps_hidden(a.points[i], b.points[j], views)
    i, j = i[clear], j[clear]
    return len(np.unique(i)) > CONTINUED_SHARE * len(a.points) and len(np.unique(j)) > CONTINUED_SHARE * len(b.points)


def gaps_hidden(
    starts: Float[ndarray, "n 3"], ends: Float[ndarray, "n 3"], views: Sequence[PosedDepth]
) -> Bool[ndarray, "n"]:
    """Whether nothing was seen between the points of each pair, and enough of the gap is behind something."""
    between = starts[:, None] + STEPS[:, None] * (ends - starts)[:, None]
    seen = sighted(between.reshape(-1, 3), views)
    hidden, passed = (one.reshape(len(starts), len(STEPS)) for one in (seen.hidden, seen.passed))
    return ~passed.any(axis=1) & (hidden.mean(axis=1) >= HIDDEN_SHARE)
