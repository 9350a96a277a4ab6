"""Which reading of poses, units, intrinsics and clock the depth of a camera supports, and how sure that is.

Depth of a frame, warped into another under a hypothesis, meets what was measured there if the hypothesis is right. No
noise level is chosen, see `warped_depth`; hypotheses are compared pair of frames by pair of frames. One is sure only if
it beats all rivals, also those that the camera did not move, or only turned.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
from jaxtyping import Float, Float32
from numpy import ndarray

from bask_data.core.image_pairs import spread_pairs
from bask_data.core.readings_evidence import PairedViews
from bask_data.core.readings_frozen import frozen_runs, moved_runs
from bask_data.core.readings_hypotheses import Readings
from bask_data.core.readings_judgement import JudgedCamera, Judgement, judgement, without_views
from bask_data.core.readings_search import Space, other_sizes, scales, searched
from bask_data.core.readings_unusual import is_unusual, with_unusual
from bask_data.core.readings_verdict import Verdict, verdict
from bask_data.core.warped_depth import DepthView, depth_view

GAPS = (1, 2, 4, 8, 16, 32, 64)
"""Distances between the frames of a pair: near ones overlap, far ones tell readings apart."""

MOST_LAG = 4
"""Frames by which a clock may be off."""

MOST_KEPT_PIXELS = 640 * 480
"""Of depth that is kept in memory per frame; of larger images every other pixel, or fewer. Sensitivity not measured."""


@dataclass(frozen=True)
class JudgeSettings:
    """How much is compared.

    Args:
        n_points: warped per pair of frames. Sensitivity not measured.
        n_pairs: about so many pairs of frames. Sensitivity not measured.
    """

    n_points: int = 900
    n_pairs: int = 36


def judge(
    n_frames: int,
    read_depth: Callable[[int], Float32[ndarray, "h w"]],
    Ks: Float[ndarray, "t 3 3"],
    world_from_cameras: Float[ndarray, "t 4 4"],
    settings: JudgeSettings = JudgeSettings(),
    *,
    otherwise: Mapping[str, Float[ndarray, "t 4 4"]] = MappingProxyType({}),
    is_ray: bool = False,
) -> Judgement:
    """What the depth of a camera says about its poses, units, intrinsics and clock.

    Args:
        n_frames: t; only frames in pairs are read, at most some 80, in increasing order, each once.
        read_depth: z-depth of a frame as read, metres, 0 = no measurement. For a stored scan:
            `lambda i: camera.depth(i)` of `bask_data.kinds.Scan(path).cameras`, with its `Ks` and
            `world_from_cameras`.
        Ks: pixels.
        world_from_cameras: as read, OpenCV axes, metres.
        otherwise: `world_from_cameras` under other readings of the same files, by the options for them.
        is_ray: whether depth was read as the length of the ray, and converted.
    """
    pairs = _pairs(n_frames, settings.n_pairs)
    if not pairs:
        return without_views(Ks[0])
    views, size = {}, (0, 0)
    runs = frozen_runs(world_from_cameras)
    for i in sorted({i for pair in [*pairs, *runs] for i in pair}):
        depth = read_depth(i)
        views[i], size = _view(depth, Ks[i], settings.n_points), depth.shape
    readings = Readings.of(world_from_cameras, otherwise)
    lags, rays = _lags(n_frames), (0, -1 if is_ray else 1)
    space = Space((), scales(), ((1.0, 1.0), *other_sizes(Ks[0], size)), lags, rays)
    paired, found, best = _found(views, pairs, readings, space)
    if is_unusual(views, pairs, readings, best):
        readings = with_unusual(readings)
        paired, found, _ = _found(views, pairs, readings, space)
    camera = JudgedCamera(world_from_cameras, readings, paired, Ks[0], moved_runs(views, runs, found.near))
    return judgement(camera, found)


def _found(
    views: dict[int, DepthView], pairs: list[tuple[int, int]], readings: Readings, space: Space
) -> tuple[PairedViews, Verdict, Float[ndarray, " p"]]:
    """The verdict about some readings in all units, sizes and clocks, and the evidence of the best for each pair."""
    paired = PairedViews(views, pairs, readings.poses, space.lags)
    trials, met, seen = searched(paired, replace(space, readings=tuple(range(len(readings.poses)))))
    found = verdict(paired, trials, met, seen)
    return paired, found, met[int(np.argmax(met.mean(axis=1)))]


def _pairs(n_frames: int, n_pairs: int) -> list[tuple[int, int]]:
    """Pairs of frames at doubling distances, spread over the recording."""
    n_gaps = sum(gap < n_frames for gap in GAPS)
    return spread_pairs(n_frames, GAPS, -(-n_pairs // max(1, n_gaps)), MOST_LAG)


def _lags(n_frames: int) -> tuple[int, ...]:
    """Frames by which the clock may be off: 0 first, few if there are few frames."""
    most = min(MOST_LAG, n_frames // 4)
    return (0, *(lag for lag in range(-most, most + 1) if lag))


def _view(depth: Float32[ndarray, "h w"], K: Float[ndarray, "3 3"], n_points: int) -> DepthView:
    step = int(np.ceil(np.sqrt(depth.size / MOST_KEPT_PIXELS)))
    K_thinned = K.copy()
    K_thinned[:2] /= step
    return depth_view(np.ascontiguousarray(depth[::step, ::step], np.float32), K_thinned, n_points)
