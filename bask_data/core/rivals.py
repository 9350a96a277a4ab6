"""Descriptor distances at keypoints of a static scene and at their rivals, in frames from other sides."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from bask_data.core.calibration import TEMPERATURES, Evidence
from bask_data.core.filters.observation import Observation, pixels_of
from bask_data.core.geometry import transform, unproject
from bask_data.core.static_truth import Visibility, visibility

TOLERANCE = 0.02
"""Metres between measured and true depth up to which a point counts as seen: noise of a depth camera at arm's length
and errors of poses. Chosen, sensitivity not measured."""

APART = 0.03
"""Share of an image's diagonal that a rival is away from the keypoint, at least: as far as a keypoint may be off to
count as found again when keypoints are chosen."""

LEVEL_STRIDE = 2
"""Step, in rows and columns, of the pixels that a heat map's mean is computed from. Chosen, sensitivity not
measured."""


def measured_evidence(
    points_world: Float[ndarray, "k 3"],
    views: Iterable[Observation],
    picked_in: Int[ndarray, "k"],
    tolerance: float = TOLERANCE,
) -> Evidence:
    """What the views of a static scene tell of its keypoints' descriptor distances.

    In each view, the pixel that matches a keypoint best, away from it, is lifted to 3D: a rival. Keypoints and rivals
    are then looked up in all other views that show them. Views are read twice, one at a time.

    Args:
        points_world: true positions, metres; NaN where unknown.
        views: with the distance map of each keypoint; depth may be finer than the maps. They may be computed each time
            they are read.
        picked_in: index of the view that each keypoint was picked in, which says nothing; -1 for none of them.
        tolerance: metres between measured and true depth up to which a point counts as seen.

    Raises:
        ValueError: `views` can be read once only.
    """
    if iter(views) is views:
        raise ValueError("views: expected a list or the like, which can be read twice, got an iterator")
    rivals = [_rivals(points_world, view, tolerance) for view in views]
    places, of = np.concatenate([at for at, _ in rivals]), np.concatenate([index for _, index in rivals])
    found_in = np.repeat(np.arange(len(rivals)), [len(index) for _, index in rivals])
    samples: list[tuple[ndarray, ...]] = []
    for i, view in enumerate(views):
        shown = np.flatnonzero(_visible(points_world, view, tolerance) & (picked_in != i))
        there = np.flatnonzero(_visible(places, view, tolerance) & (found_in != i))
        there = there[_apart(places[there], points_world[of[there]], view)]
        level, mean = _heat(view.distance)
        off = np.linalg.norm(mean[shown] - _cells(points_world[shown], view)[:, None], axis=-1)
        true, rival = _at(points_world[shown], shown, view), _at(places[there], of[there], view)
        diagonal = np.hypot(*view.distance.shape[1:])
        samples.append((true, shown, level[shown], rival, of[there], level[of[there]], off / diagonal))
    return Evidence(*map(np.concatenate, zip(*samples, strict=True)))


def _rivals(
    points_world: Float[ndarray, "k 3"], view: Observation, tolerance: float
) -> tuple[Float[ndarray, "n 3"], Int[ndarray, "n"]]:
    """The best match of each keypoint away from it, metres, world frame, and the keypoint's index. Of a keypoint that
    may be visible or not, there is none."""
    state = np.full(len(points_world), Visibility.UNKNOWN, dtype=np.int8)
    known = np.isfinite(points_world).all(axis=1)
    state[known] = visibility(points_world[known], view.depth, view.K, view.world_from_camera, tolerance)
    of = np.flatnonzero(state != Visibility.UNKNOWN)
    height, width = view.distance.shape[1:]
    scale = np.array([view.depth.shape[1] / width, view.depth.shape[0] / height])
    v, u = np.mgrid[:height, :width]
    uv = (np.stack([u, v], axis=-1) + 0.5) * scale - 0.5
    column, row = np.rint(uv).astype(int).reshape(-1, 2).clip(0, np.array(view.depth.shape[::-1]) - 1).T
    depth = view.depth[row, column].astype(np.float64)
    if not len(of) or not (depth > 0).any():
        return np.empty((0, 3)), np.empty(0, dtype=int)
    uv = uv.reshape(-1, 2)
    at = np.nan_to_num(pixels_of(points_world[of], view), nan=-1e9)
    chosen, kept = np.empty(len(of), dtype=int), np.empty(len(of), dtype=bool)
    for j, i in enumerate(of):
        away = (np.abs(uv - at[j]).max(axis=1) > _radius(view)) & (depth > 0)
        chosen[j], kept[j] = np.where(away, view.distance[i].ravel(), np.inf).argmin(), away.any()
    chosen, of = chosen[kept], of[kept]
    return transform(view.world_from_camera, unproject(uv[chosen], depth[chosen], view.K)), of


def _visible(points_world: Float[ndarray, "n 3"], view: Observation, tolerance: float) -> Bool[ndarray, "n"]:
    """Which points are visible; unknown ones are not."""
    known = np.isfinite(points_world).all(axis=1)
    visible = np.zeros(len(points_world), dtype=bool)
    state = visibility(points_world[known], view.depth, view.K, view.world_from_camera, tolerance)
    visible[known] = state == Visibility.VISIBLE
    return visible


def _radius(view: Observation) -> float:
    """`APART`, pixels of the depth image."""
    return float(APART * np.hypot(*view.depth.shape))


def _apart(
    points_world: Float[ndarray, "n 3"], keypoints_world: Float[ndarray, "n 3"], view: Observation
) -> Bool[ndarray, "n"]:
    """Which visible points are away from a keypoint in the image, be that visible or not."""
    off = np.nan_to_num(pixels_of(points_world, view) - pixels_of(keypoints_world, view), nan=np.inf)
    return np.abs(off).max(axis=1, initial=0.0) > _radius(view)


def _cells(points_world: Float[ndarray, "n 3"], view: Observation) -> Float[ndarray, "n 2"]:
    """Positions (u, v) of visible points, pixels of the distance map."""
    height, width = view.distance.shape[1:]
    scale = np.array([width / view.depth.shape[1], height / view.depth.shape[0]])
    return (pixels_of(points_world, view) + 0.5) * scale - 0.5


def _at(points_world: Float[ndarray, "n 3"], of: Int[ndarray, "n"], view: Observation) -> Float[ndarray, "n"]:
    """Distance of visible points to the descriptor of a keypoint, at the nearest pixel."""
    height, width = view.distance.shape[1:]
    u, v = np.rint(_cells(points_world, view)).astype(int).clip(0, [width - 1, height - 1]).T
    return view.distance[of, v, u].astype(np.float64)


def _heat(distance: Float[ndarray, "k h w"]) -> tuple[Float[ndarray, "k a"], Float[ndarray, "k a 2"]]:
    """Level -log(mean of exp(-alpha z)) / alpha at each of `TEMPERATURES`, and the mean pixel of the heat map."""
    z = distance[:, ::LEVEL_STRIDE, ::LEVEL_STRIDE]
    least = z.min(axis=(1, 2)).astype(np.float64)
    v, u = (np.arange(0, n, LEVEL_STRIDE) for n in distance.shape[1:])
    level, mean = np.empty((len(z), len(TEMPERATURES))), np.empty((len(z), len(TEMPERATURES), 2))
    for i, alpha in enumerate(TEMPERATURES):
        heat = np.exp(-alpha * (z - z.min(axis=(1, 2), keepdims=True)))
        columns, rows = heat.sum(axis=1, dtype=np.float64), heat.sum(axis=2, dtype=np.float64)
        total = columns.sum(axis=1)
        level[:, i] = least - np.log(total / z[0].size) / alpha
        mean[:, i] = np.stack([columns @ u, rows @ v], axis=-1) / total[:, None]
    return level, mean
