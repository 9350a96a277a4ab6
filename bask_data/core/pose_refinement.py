"""Whether depth finds an error in the poses of a camera, which kind of error, and the poses without it.

Rival explanations are fitted on some pairs of views and compared on others: none, one rigid error of all poses (that of
a hand-eye calibration), poses that drift.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float, Float32
from numpy import ndarray

from bask_data.core.drift_refinement import interpolated, undrifted
from bask_data.core.geometry import invert_rigid, rotation_angle, view_change
from bask_data.core.hand_eye_refinement import Correction, hand_eye
from bask_data.core.pair_alignment import aligned, residual
from bask_data.core.surface_views import SurfaceView, angles_between, fixed_to_camera, meetings, surface_view

Model = Literal["none", "hand-eye", "drift"]
Verdict = Literal["refined", "no better", "cannot tell"]

MOST_COMPARED = 60
"""Most frames that are compared; drift of frames between is interpolated. Chosen to bound time."""

N_PAIRS, N_HELD_OUT = 120, 40
"""Most pairs of views that corrections are fitted on and judged by. Sensitivity not measured."""

LARGEST_IMAGE = 700
"""Pixels of width above which depth is read at every second, third ... pixel. Chosen to bound memory."""

OVERLAP, SAME_DEPTH = 0.3, 0.1
"""Views overlap if this share of the points of one meets depth of the other that differs by at most this share: wide
enough for the errors that are looked for. Sensitivity not measured."""

LARGEST_TURN = np.radians(70.0)
"""Angle between views that see too little of the same surfaces. Sensitivity not measured."""

STILL_M, STILL_RAD = 0.01, float(np.radians(2.0))
"""A camera that nowhere moves and turns further, metres and radians, tells nothing of its poses. Sensitivity not
measured."""

LEAST_HELD_OUT = 8
"""Held-out pairs below which nothing can be told: the standard error of fewer is a guess."""

SURE_T, SURE_GAIN = 2.5, 0.05
"""An explanation beats another if the residual of held-out pairs is smaller by this share, and by so many standard
errors, paired. Sensitivity not measured."""

LARGEST_DEVIATION = (0.001, float(np.radians(0.15)))
"""Standard deviation, metres and radians, above which a hand-eye correction cannot be told: twice these is what a
calibration should be good for, 2 mm and 0.3 degrees."""


@dataclass(frozen=True)
class Residual:
    """How far views are from meeting, over held-out pairs.

    Args:
        distance: mean point-to-plane distance of each pair, metres.
        shift, angle: medians of what each pair would still have to move for its depth to meet, metres and radians.
    """

    distance: Float[ndarray, " p"]
    shift: float
    angle: float

    @property
    def mean(self) -> float:
        """Mean over the pairs, metres; NaN without any."""
        known = self.distance[np.isfinite(self.distance)]
        return float(known.mean()) if len(known) else float("nan")


@dataclass(frozen=True)
class Refinement:
    """Poses of a camera refined by its depth, or why not.

    Args:
        world_from_cameras: corrected if `verdict` is refined, else as given.
        given_from_true: the hand-eye error, camera frame: true world_from_camera = given @ it; None unless one was
            found.
        correction: of the hand-eye model, if it was tried.
        before, after: held-out residuals of the given poses, and of the best explanation.
        why: one sentence.
        n_pairs: pairs of views that overlap.
    """

    model: Model
    verdict: Verdict
    world_from_cameras: Float[ndarray, "t 4 4"]
    given_from_true: Float[ndarray, "4 4"] | None
    correction: Correction | None
    before: Residual | None
    after: Residual | None
    why: str
    n_pairs: int


def refined(
    read_depth: Callable[[int], Float32[ndarray, "h w"]],
    Ks: Float[ndarray, "t 3 3"],
    world_from_cameras: Float[ndarray, "t 4 4"],
    model: Literal["auto", "hand-eye", "drift"] = "auto",
    progress: Callable[[Sequence[int]], Iterable[int]] = lambda frames: frames,
) -> Refinement:
    """The poses with the error that depth finds in them, if any, taken out.

    Args:
        read_depth: z-depth of a frame, metres, without what is too near or too far; 0 = none.
        progress: wraps the frames that are read.
    """
    given = world_from_cameras
    if _is_still(given):
        why = "the camera hardly moves"
        return Refinement("none", "cannot tell", given, None, None, None, None, why, 0)
    index = np.unique(np.linspace(0, len(given) - 1, MOST_COMPARED).round().astype(int)).tolist()
    views = _views(read_depth, Ks, given, index, progress)
    chosen = given[index]
    fitted, held_out, n_pairs = _pairs(views, chosen)
    if len(held_out) < LEAST_HELD_OUT:
        why = f"{n_pairs} pairs of frames see the same surfaces, {4 * LEAST_HELD_OUT} are needed"
        return Refinement("none", "cannot tell", given, None, None, None, None, why, n_pairs)
    before = _residual(views, chosen, held_out)
    tried: dict[Model, tuple[Float[ndarray, "k 4 4"], Residual]] = {}
    correction, rest = None, None
    if model in ("auto", "hand-eye"):
        correction = hand_eye(views, chosen, fitted)
        poses = chosen @ correction.given_from_true
        tried["hand-eye"] = (poses, _residual(views, poses, held_out))
    if model in ("auto", "drift"):
        poses = undrifted(views, chosen, fitted)
        tried["drift"] = (poses, _residual(views, poses, held_out))
        rest = hand_eye(views, poses, fitted) if model == "auto" else None
    best, verdict, why = _judged(before, {name: after for name, (_, after) in tried.items()}, correction, rest)
    shown = tried[best][1] if best != "none" else min((after for _, after in tried.values()), key=lambda r: r.mean)
    poses = given
    if verdict == "refined":
        poses = given @ correction.given_from_true if best == "hand-eye" and correction else given
        poses = interpolated(tried["drift"][0], given, index) if best == "drift" else poses
    E = correction.given_from_true if verdict == "refined" and best == "hand-eye" and correction else None
    return Refinement(best, verdict, poses, E, correction, before, shown, why, n_pairs)


_HELPS = {"hand-eye": "one rigid correction of all poses helps", "drift": "corrections of each pose help"}


def _judged(
    before: Residual, after: dict[Model, Residual], correction: Correction | None, rest: Correction | None
) -> tuple[Model, Verdict, str]:
    """The explanation that held-out pairs support: the simplest one that no other beats.

    Args:
        correction: the hand-eye error of the given poses; None if it is not asked for.
        rest: that of the poses without drift.
    """
    better = [name for name, each in after.items() if _beats(each, before)]
    if not better:
        why = "no correction makes held-out pairs of frames meet clearly better"
        if correction and _undetermined(correction):
            why += f"; a hand-eye error smaller than {_known_to(correction)} could not be told from this motion"
        return "none", "no better", why
    drift_wins = "drift" in better and ("hand-eye" not in better or _beats(after["drift"], after["hand-eye"]))
    # Drift could explain a hand-eye error, too, and would leave the cameras where they should not be; and what drifts
    # makes a hand-eye error uncertain that would be clear without.
    doubt = _undetermined(rest if drift_wins else correction)
    if doubt:
        return better[0], "cannot tell", f"{_HELPS[better[0]]}, but {doubt}"
    if drift_wins:
        return "drift", "refined", "corrections of each pose make held-out pairs of frames meet"
    return "hand-eye", "refined", "one rigid correction of all poses makes held-out pairs of frames meet"


def _undetermined(correction: Correction | None) -> str:
    """Why a correction is too uncertain to be used; empty if it is not, or if none was asked for."""
    most_m, most_rad = LARGEST_DEVIATION
    if correction is None or (correction.deviation_m <= most_m and correction.deviation_rad <= most_rad):
        return ""
    return f"a hand-eye error is only known to {_known_to(correction)}: the camera turns too little, or about one axis"


def _known_to(correction: Correction) -> str:
    """Twice the standard deviations in words."""
    return f"{2000 * correction.deviation_m:.1f} mm and {2 * np.degrees(correction.deviation_rad):.2f} degrees"


def _is_still(world_from_cameras: Float[ndarray, "t 4 4"]) -> bool:
    shift, angle = view_change(np.broadcast_to(world_from_cameras[0], world_from_cameras.shape), world_from_cameras)
    return bool(shift.max() < STILL_M and angle.max() < STILL_RAD)


def _beats(winner: Residual, other: Residual) -> bool:
    """Whether held-out residuals are smaller, by a paired t statistic: a threshold, as pairs that share frames are not
    independent."""
    known = np.isfinite(winner.distance) & np.isfinite(other.distance)
    gain = other.distance[known] - winner.distance[known]
    if len(gain) < LEAST_HELD_OUT or gain.mean() <= SURE_GAIN * other.distance[known].mean():
        return False
    # Pairs that no longer meet at all would otherwise not count.
    if np.isfinite(winner.distance).sum() < 0.9 * np.isfinite(other.distance).sum():
        return False
    return bool(gain.mean() > SURE_T * gain.std(ddof=1) / np.sqrt(len(gain)))


def _views(
    read_depth: Callable[[int], Float32[ndarray, "h w"]],
    Ks: Float[ndarray, "t 3 3"],
    world_from_cameras: Float[ndarray, "t 4 4"],
    index: Sequence[int],
    progress: Callable[[Sequence[int]], Iterable[int]],
) -> list[SurfaceView]:
    """The chosen frames as surfaces, without what is fixed to the camera."""
    depths, intrinsics = [], []
    for i in progress(index):
        depth = read_depth(i)
        every = -(-depth.shape[1] // LARGEST_IMAGE)
        K = Ks[i].copy()
        K[:2] /= every  # Pixel centres are integers: pixel 0 stays where it is.
        depths.append(depth[::every, ::every])
        intrinsics.append(K)
    fixed = fixed_to_camera(depths, world_from_cameras[list(index)])
    return [surface_view(np.where(fixed, np.float32(0), depth), K) for depth, K in zip(depths, intrinsics, strict=True)]


def _pairs(
    views: Sequence[SurfaceView], world_from_cameras: Float[ndarray, "t 4 4"]
) -> tuple[list[tuple[int, int]], list[tuple[int, int]], int]:
    """Overlapping pairs to fit on and to judge by, from small to large turns, and how many there are."""
    angle = angles_between(world_from_cameras)
    overlapping = []
    for i in range(len(views)):
        for j in range(i + 1, len(views)):
            if angle[i, j] <= LARGEST_TURN and _overlap(
                views[i], views[j], world_from_cameras[i], world_from_cameras[j]
            ):
                overlapping.append((i, j))
    overlapping.sort(key=lambda pair: angle[pair])
    held_out = overlapping[2::4]
    fitted = [pair for k, pair in enumerate(overlapping) if k % 4 != 2]
    return _spread(fitted, N_PAIRS), _spread(held_out, N_HELD_OUT), len(overlapping)


def _spread(pairs: list[tuple[int, int]], most: int) -> list[tuple[int, int]]:
    return [pairs[k] for k in np.unique(np.linspace(0, len(pairs) - 1, most).astype(int))] if pairs else []


def _overlap(
    a: SurfaceView, b: SurfaceView, world_from_a: Float[ndarray, "4 4"], world_from_b: Float[ndarray, "4 4"]
) -> bool:
    b_from_a = invert_rigid(world_from_b) @ world_from_a
    met = meetings(a, b, b_from_a)
    z = met.points_a @ b_from_a[2, :3] + b_from_a[2, 3]
    return bool((np.abs(z - met.points_b[:, 2]) < SAME_DEPTH * z).sum() > OVERLAP * max(met.n_points, 1))


def _residual(
    views: Sequence[SurfaceView], world_from_cameras: Float[ndarray, "t 4 4"], pairs: Sequence[tuple[int, int]]
) -> Residual:
    distance, left = [], []
    for i, j in pairs:
        j_from_i = invert_rigid(world_from_cameras[j]) @ world_from_cameras[i]
        distance.append(residual(views[i], views[j], j_from_i))
        motion = aligned(views[i], views[j], j_from_i)
        if motion.is_measured:
            left.append(invert_rigid(j_from_i) @ motion.b_from_a)
    moves = np.array(left) if left else np.full((1, 4, 4), np.nan)
    shift = float(np.median(np.linalg.norm(moves[:, :3, 3], axis=1)))
    return Residual(np.array(distance), shift, float(np.median(rotation_angle(moves[:, :3, :3]))))
