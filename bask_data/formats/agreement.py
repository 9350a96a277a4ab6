"""Which reading of a recording its own depth supports: poses, unit, clock, and what depth measures.

Inverted poses, poses in other camera axes or units, and poses of the neighbouring frame pass every check of single
files. Depth of one frame, warped into another, tells them apart: readings are compared pair of frames by pair of
frames. A reading is sure only if it beats every rival, also the one that the camera did not move.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from bask_data.core.geometry import invert_rigid, view_change
from bask_data.core.warped_depth import DepthView, depth_view, evidence
from bask_data.formats.recording import CameraRecording
from bask_data.formats.verdict import CLEAR_GAIN, STILL, Agreement

GAPS = (1, 2, 4, 8, 16, 32, 64)
"""Distances between the frames of a pair: near ones overlap, far ones tell readings apart."""

PAIRS_PER_GAP = 5
"""Pairs per distance, spread over the recording. Sensitivity not measured."""

N_WARPED = 900
"""Points warped per pair. Sensitivity not measured."""

SURE_T, SURE_GAIN = 2.5, 0.01
"""A reading beats another if its mean evidence is larger by this gain, and by so many standard errors over pairs."""

MOVED_T = 2.0
"""A reading must beat the camera that does not move by so many standard errors over the pairs."""

POOR_EVIDENCE = 0.25
"""Mean evidence below which depth and poses do not fit under a reading. Exact synthetic data have 0.86, hand-held
recordings 0.5 to 0.7."""

SCALED_EVIDENCE = 0.4
"""Mean evidence below which poses are tried in other units, and which they must reach then. Sensitivity not
measured."""

SCALES = np.geomspace(1 / 32, 32, 350)
"""Factors that distances between poses are tried with, 2 % apart, as far as depth of a frame must agree."""

RESTING_EVIDENCE = 0.5
"""Mean evidence below which a camera whose poses are all the same may have moved. Sensitivity not measured."""

LEAST_PAIRS = 4
"""Pairs below which nothing is sure: the standard error of fewer is a guess."""

REFUSED_PAIRS = 12
"""Pairs below which a recording that nothing fits is not refused: few frames may hardly overlap."""

PLAUSIBLE_SCENE = (0.05, 20.0)
"""Median depth, metres, of scenes that another unit of depth may be suggested for."""

UNITS = (10.0, 0.1, 1000.0, 0.001, 5.0, 0.2, 4.0, 0.25)
"""Factors between units of depth that are mixed up: decimal ones, 1/5000 (TUM) and 1/4000 m against millimetres."""


@dataclass(frozen=True)
class _Reading:
    """How poses and depth might be meant.

    Args:
        options: the options for it, if there are any.
        fix: what to do to the files if there are none.
        scale, is_ray: how depth is read, as in `evidence`.
    """

    name: str
    poses: Float[ndarray, "t 4 4"]
    options: str = ""
    scale: float = 1.0
    is_ray: bool = False
    fix: str = ""


def agreement(
    camera: CameraRecording,
    otherwise: dict[str, Float[ndarray, "t 4 4"]],
    *,
    scale_option: str = "",
    is_ray: bool = False,
) -> Agreement:
    """What the depth of some pairs of frames says about the given reading.

    Args:
        otherwise: `world_from_cameras` under other readings of the same files, by the options for them.
        scale_option: the option that states the unit of depth, if the format has one: `--depth-scale`.
        is_ray: whether depth was read as the length of the ray already.
    """
    pairs = _pairs(camera.n_frames)
    if not pairs:
        return Agreement(0.0, 0, "cannot tell")
    views = {
        i: depth_view(camera.read_depth(i) * np.float32(camera.depth_scale), camera.Ks[i], N_WARPED)
        for i in sorted({i for pair in pairs for i in pair})
    }
    given = _Reading("the given options", camera.world_from_cameras)
    if _is_fixed(camera.world_from_cameras):
        return _at_rest(_scores(given, views, pairs))
    readings = [given, *_others(camera, views, otherwise, scale_option, is_ray)]
    scores = np.stack([_scores(reading, views, pairs) for reading in readings])
    still = _scores(_Reading(STILL, np.tile(np.eye(4), (camera.n_frames, 1, 1))), views, pairs)
    judged = _judged(readings, scores, still, _has_moved(camera, pairs))
    if judged.verdict == "fits" or judged.verdict == "other" or judged.share >= SCALED_EVIDENCE:
        return judged
    return _at_other_scale(judged, given, views, pairs, np.vstack([scores, still])) or judged


def _others(
    camera: CameraRecording,
    views: dict[int, DepthView],
    otherwise: dict[str, Float[ndarray, "t 4 4"]],
    scale_option: str,
    is_ray: bool,
) -> list[_Reading]:
    """The readings that are held against the given one."""
    poses = camera.world_from_cameras
    readings = [_Reading(name, other, name) for name, other in otherwise.items()]
    index = np.arange(camera.n_frames)
    if camera.n_frames > 3:
        for lag, neighbour in ((-1, "previous"), (1, "next")):
            shifted = poses[np.clip(index + lag, 0, camera.n_frames - 1)]
            readings.append(_Reading(f"the pose of the {neighbour} frame", shifted))
    if not is_ray:
        readings.append(_Reading("--depth-is ray (depth along the ray, not z)", poses, "--depth-is ray", is_ray=True))
    depths = [view.z for view in views.values() if len(view.z)]
    median = float(np.median(np.concatenate(depths))) if depths else 0.0
    for factor in UNITS:
        if PLAUSIBLE_SCENE[0] <= median * factor <= PLAUSIBLE_SCENE[1]:
            option = f"{scale_option} {camera.depth_scale * factor:.6g}" if scale_option else ""
            name = f"depth {factor:g} times as large"
            fix = f"correct the unit of depth in the files: {name}"
            readings.append(_Reading(option or name, poses, option, scale=factor, fix=fix))
    return readings


def _at_other_scale(
    judged: Agreement,
    given: _Reading,
    views: dict[int, DepthView],
    pairs: list[tuple[int, int]],
    scores: Float[ndarray, "r p"],
) -> Agreement | None:
    """Poses in another unit than metres, by any factor, as those of structure from motion; None if that fits no better.

    Args:
        scores: of all other readings, which it must beat clearly.
    """
    if len(pairs) < REFUSED_PAIRS:
        return None
    of_scale = np.stack([_scores(replace(given, scale=1 / factor), views, pairs) for factor in SCALES])
    best = int(np.argmax(of_scale.mean(axis=1)))
    share = float(of_scale[best].mean())
    rival = float(scores.mean(axis=1).max())
    is_clear = share >= max(SCALED_EVIDENCE, CLEAR_GAIN * rival)
    if not is_clear or not all(_beats(of_scale[best], other, SURE_T, SURE_GAIN) for other in scores):
        return None
    better = f"distances between the poses {SCALES[best]:.3g} times as large"
    fix = f"scale the positions of the poses to metres, by about {SCALES[best]:.3g}, or correct the unit of depth"
    return Agreement(judged.share, judged.n_pairs, "other", better, share, fix=fix)


def _at_rest(scores: Float[ndarray, " p"]) -> Agreement:
    """What depth says of a camera that rests by its poses: that it moved, if little of its depth stays where it is."""
    share = float(scores.mean())
    if share >= RESTING_EVIDENCE or len(scores) < LEAST_PAIRS:
        return Agreement(0.0, len(scores), "cannot tell", rivals=(STILL,))
    is_sure = len(scores) >= REFUSED_PAIRS and share < POOR_EVIDENCE
    return Agreement(share, len(scores), "moved" if is_sure else "may have moved", rivals=(STILL,))


def _judged(
    readings: list[_Reading], scores: Float[ndarray, "r p"], still: Float[ndarray, " p"], has_moved: bool
) -> Agreement:
    n_pairs = scores.shape[1]
    mean = scores.mean(axis=1)
    best = int(np.argmax(mean))
    made = Agreement(float(mean[0]), n_pairs, "fits")
    unbeaten = [
        readings[i].name
        for i in range(len(readings))
        if i != best and not _beats(scores[best], scores[i], SURE_T, SURE_GAIN)
    ]
    if not _beats(scores[best], still, MOVED_T, 0.0):
        unbeaten.append(STILL)
    if has_moved and n_pairs >= REFUSED_PAIRS and mean[best] < POOR_EVIDENCE and STILL in unbeaten:
        return replace(made, verdict="nothing fits")
    if best == 0 and not unbeaten:
        return made
    if best != 0 and not unbeaten and mean[best] >= POOR_EVIDENCE:
        reading = readings[best]
        return replace(
            made,
            verdict="other",
            better=reading.name,
            better_share=float(mean[best]),
            options=reading.options,
            fix=reading.fix,
        )
    rivals = [name for name in unbeaten if name != readings[0].name]
    if best != 0:
        rivals = [readings[best].name, *rivals]
    return replace(made, verdict="cannot tell", rivals=tuple(rivals))


def _beats(winner: Float[ndarray, " p"], other: Float[ndarray, " p"], t: float, gain: float) -> bool:
    """Whether one reading's evidence is larger than another's, by a paired t statistic over the pairs of frames."""
    difference = winner - other
    if len(difference) < LEAST_PAIRS or difference.mean() <= gain:
        return False
    error = float(difference.std(ddof=1)) / np.sqrt(len(difference))
    return bool(difference.mean() > t * error)


def _is_fixed(world_from_cameras: Float[ndarray, "t 4 4"]) -> bool:
    """Whether all poses are the same: those of a camera on a stand."""
    return bool(np.allclose(world_from_cameras, world_from_cameras[:1], atol=1e-9))


def _has_moved(camera: CameraRecording, pairs: list[tuple[int, int]]) -> bool:
    """Whether the poses move at all between the frames of the pairs."""
    a, b = np.array(pairs).T
    distance, angle = view_change(camera.world_from_cameras[a], camera.world_from_cameras[b])
    return bool((distance > 0.01).any() or (angle > np.radians(1)).any())


def _pairs(n_frames: int) -> list[tuple[int, int]]:
    """Pairs of frames at doubling distances, spread over the recording."""
    pairs = []
    for gap in GAPS:
        if gap < n_frames:
            n_starts = min(PAIRS_PER_GAP, n_frames - gap)
            pairs += [
                (int(i), int(i) + gap) for i in np.unique(np.linspace(0, n_frames - 1 - gap, n_starts).astype(int))
            ]
    return pairs


def _scores(reading: _Reading, views: dict[int, DepthView], pairs: list[tuple[int, int]]) -> Float[ndarray, " p"]:
    """Evidence of each pair for a reading."""
    poses = reading.poses
    return np.array(
        [
            evidence(views[a], views[b], invert_rigid(poses[b]) @ poses[a], reading.scale, reading.is_ray)
            for a, b in pairs
        ]
    )
