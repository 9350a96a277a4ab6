"""Faults of images and stamps that a recording's frames show among themselves, without their poses being right."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray
from scipy.ndimage import median_filter

from bask_data.core.geometry import view_change
from bask_data.core.sensor_frames import FrameMeasures

ONE_COLOUR = 0.97
"""Share of the pixels within a few grey levels above which a frame shows nothing. Real frames have at most 0.06."""

BLURRED = 0.35
"""Sharpness relative to that of the frames around below which a frame is blurred: half as sharp is usual in motion."""

SPARSE_DIP = 0.5
"""Measured share relative to that of the frames around below which a frame's depth is patchy."""

MOVED_PX = 2.0
"""Pixels by which a pose must move the image for colour to have to change: a static scene can look alike below."""

CHANGED_GREY = 0.5
"""Mean change of grey levels by which images differ beyond compression. Noise of a camera at rest alone is above."""

LONG_STEP = 3.0
"""Times the usual distance of stamps that counts as a gap. Sensitivity not measured."""


@dataclass(frozen=True)
class Repeats:
    """Frames with images of the frame before.

    Args:
        colour: numbers of frames that repeat colour although the pose or the depth changed.
        depth: numbers of frames that repeat depth although colour changed.
        all: numbers of frames that repeat colour, depth and pose.
    """

    colour: list[int]
    depth: list[int]
    all: list[int]


def one_coloured(frames: Sequence[FrameMeasures]) -> list[FrameMeasures]:
    """Frames of one colour: black, white, a lens that was covered, a stream that failed."""
    return [frame for frame in frames if frame.one_colour >= ONE_COLOUR]


def repeats(frames: Sequence[FrameMeasures], world_from_cameras: Float[ndarray, "t 4 4"]) -> Repeats:
    """Frames with images that are those of the frame before, bit by bit."""
    found = Repeats([], [], [])
    for a, b in pairwise(frames):
        distance, angle = view_change(world_from_cameras[a.index], world_from_cameras[b.index])
        # In pixels, as a robot that begins to move changes its pose before its images.
        shown = b.blocks.K[0, 0] * (float(angle) + float(distance) / max(np.nan_to_num(b.typical_depth, nan=1.0), 1e-3))
        same_pose = shown < MOVED_PX
        same_colour, same_depth = a.colour_hash == b.colour_hash, a.depth_hash == b.depth_hash
        empty = b.measured == 0 and a.measured == 0
        if same_colour and same_pose and (same_depth or not _surface_changed(a, b)):
            found.all.append(b.index)
        elif same_colour and a.one_colour < ONE_COLOUR:
            found.colour.append(b.index)
        elif same_depth and not empty and np.abs(a.blocks.grey - b.blocks.grey).mean() > CHANGED_GREY:
            found.depth.append(b.index)
    return found


def _surface_changed(a: FrameMeasures, b: FrameMeasures) -> bool:
    """Whether depth shows something else, not only other noise."""
    z_a, z_b = a.blocks.points[..., 2], b.blocks.points[..., 2]
    both = np.isfinite(z_a) & np.isfinite(z_b)
    change = np.abs(z_a - z_b)[both] / z_a[both]
    return bool(len(change) and (change > 0.05).mean() > 0.02)


def around(values: Float[ndarray, " n"]) -> Float[ndarray, " n"]:
    """The median of the seven values around each."""
    return np.asarray(median_filter(values, size=min(7, len(values)), mode="nearest"))


def blurred(frames: Sequence[FrameMeasures]) -> list[tuple[int, float]]:
    """Frames far less sharp than those around, and their sharpness relative to these."""
    if len(frames) < 5:
        return []
    sharpness = np.array([frame.sharpness for frame in frames])
    relative = sharpness / np.maximum(around(sharpness), 1e-9)
    seen = np.array([frame.one_colour < ONE_COLOUR for frame in frames])
    return [(frames[k].index, float(relative[k])) for k in np.flatnonzero((relative < BLURRED) & seen).tolist()]


def patchy(frames: Sequence[FrameMeasures]) -> list[tuple[int, float]]:
    """Frames with some depth, but far less than those around, and the share they have."""
    if len(frames) < 5:
        return []
    measured = np.array([frame.measured for frame in frames])
    dips = (measured > 0) & (measured < SPARSE_DIP * around(measured))
    return [(frames[k].index, float(measured[k])) for k in np.flatnonzero(dips).tolist()]


def brightness_jumps(steps: Sequence[tuple[int, float]], least: float) -> list[tuple[int, float]]:
    """Frames whose surfaces are suddenly brighter or darker, by a factor beyond `least` and beyond what is usual.

    Args:
        steps: of `sensor_motion.brightness_steps`.
    """
    if len(steps) < 4:
        return []
    logs = np.array([np.log(factor) for _, factor in steps])
    usual = float(np.median(np.abs(logs)))
    jumps = np.abs(logs) > max(np.log(least), 5 * usual)
    return [steps[k] for k in np.flatnonzero(jumps).tolist()]


@dataclass(frozen=True)
class Stamps:
    """Distances of the stamps of a camera.

    Args:
        period: median, seconds.
        gaps: places after which stamps are missing, and the seconds until the next.
        jitter: median deviation from the period, relative to it.
        backwards: places after which time does not go on.
    """

    period: float
    gaps: list[tuple[int, float]]
    jitter: float
    backwards: list[int]


def stamps(time: Float[ndarray, " t"]) -> Stamps | None:
    """What is said by the stamps of a camera; None for fewer than four."""
    if len(time) < 4:
        return None
    steps = np.diff(time)
    period = float(np.median(steps))
    far: Bool[ndarray, " n"] = steps > LONG_STEP * period if period > 0 else np.zeros(len(steps), bool)
    jitter = float(np.median(np.abs(steps - period))) / period if period > 0 else 0.0
    gaps = [(int(k), float(steps[k])) for k in np.flatnonzero(far).tolist()]
    return Stamps(period, gaps, jitter, [int(k) for k in np.flatnonzero(steps <= 0).tolist()])
