"""Poses of single frames, compared by depth with the frames before and after: never with the majority.

A frame whose pose is wrong lies far from both neighbours, while these lie near each other. Frames that share a pose
although their surfaces do not, a step in the path that the surfaces do not make, and frames far apart in time that
disagree more than a change of the view explains, are told apart from it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.optimize import nnls

from bask_data.core.geometry import invert_rigid, view_change
from bask_data.core.sensor_alignment import Alignment, aligned
from bask_data.core.sensor_frames import BlockPoints, FrameMeasures

SAME_VIEW = (5e-5, 1e-4)
"""Metres and radians within which poses are the same: below the noise of encoders and of tracking."""

CLEARLY = 2.5
"""A frame's distance from both neighbours, relative to theirs from each other, for its pose to be wrong."""

LEAST_OFF = (0.002, 0.004)
"""(a, b): a + b z metres, the least error of a pose that counts as wrong. Real recordings differ by 0.1 to 0.5 % of the
depth from frame to frame."""

ABOVE_USUAL = 3.0
"""An error of a pose, relative to the median of the recording, for it to stand out."""

LOST = 0.3
"""Share of the landing points that must meet a surface; below it two frames with the same surface in view disagree."""

STATIC = 0.75
"""Share of the landing points that must meet a surface, once corrected, for a scene to count as still. Neighbouring
frames of real scans have 0.84 to 1; a simulated wrist's camera above the object it grasps has 0.4."""

LEAST_SURFACE = 0.1
"""Least share of an image's blocks with a surface for its lack in another frame to say anything."""

N_FAR = 40
"""Pairs of frames far apart in time. Sensitivity not measured."""

FAR_VIEW = (0.5, np.radians(50.0))
"""Distance of cameras, relative to depth, and angle up to which frames far apart in time are compared."""


@dataclass(frozen=True)
class FramePair:
    """Two frames and what their surfaces say; `i` and `j` are places in the sequence of measured frames.

    Args:
        found: None where the surfaces have too little in common.
        distance, angle: between the cameras, metres and radians.
    """

    i: int
    j: int
    found: Alignment | None
    distance: float
    angle: float

    @property
    def moved(self) -> float:
        """Metres by which the surfaces disagree; infinite where hardly any of it meets, NaN if unknown."""
        if self.found is None:
            return float("nan")
        return self.found.moved if self.found.agree >= LOST else float("inf")


@dataclass(frozen=True)
class WrongPose:
    """A frame, or a run of frames, whose poses the surfaces contradict.

    Args:
        first, last: numbers of the frames.
        shift, angle: metres and radians by which they are off, at the surface.
        usual: metres by which surfaces of neighbouring frames disagree otherwise.
    """

    first: int
    last: int
    shift: float
    angle: float
    usual: float


@dataclass(frozen=True)
class Drift:
    """Growth of the disagreement with time.

    Args:
        near, far: metres by which surfaces of neighbouring frames, and of frames far apart in time, disagree in the
            median.
        by_time: metres of `far` that the change of the view does not explain.
        shift, angle: metres and radians of the correction of frames far apart, in the median.
        n_pairs: pairs far apart.
    """

    near: float
    far: float
    by_time: float
    shift: float
    angle: float
    n_pairs: int


class NeighbourPairs:
    """Pairs of measured frames, aligned when they are asked for and once."""

    def __init__(self, frames: Sequence[FrameMeasures], world_from_cameras: Float[ndarray, "t 4 4"]) -> None:
        self.frames = frames
        self.poses = world_from_cameras[[frame.index for frame in frames]]
        self._pairs: dict[tuple[int, int], FramePair] = {}

    def __len__(self) -> int:
        return len(self.frames)

    def pair(self, i: int, j: int) -> FramePair:
        """The pair of two measured frames."""
        if (i, j) not in self._pairs:
            a, b = self.poses[i], self.poses[j]
            found = aligned(self.frames[i].blocks, self.frames[j].blocks, invert_rigid(b) @ a)
            distance, angle = view_change(a, b)
            self._pairs[i, j] = FramePair(i, j, found, float(distance), float(angle))
        return self._pairs[i, j]

    def neighbours(self, gap: int = 1) -> list[FramePair]:
        """All pairs of frames so many places apart."""
        return [self.pair(i, i + gap) for i in range(len(self) - gap)]

    @cached_property
    def usual(self) -> float:
        """Median disagreement of neighbouring frames of different poses, metres; NaN if there are none."""
        moved = [pair.moved for pair in self.neighbours() if np.isfinite(pair.moved) and not _same_pose(pair)]
        return float(np.median(moved)) if moved else float("nan")

    def limit(self, pair: FramePair) -> float:
        """Metres above which a pair's disagreement stands out."""
        depth = pair.found.depth if pair.found else self.frames[pair.i].typical_depth
        usual = self.usual
        return max(LEAST_OFF[0] + LEAST_OFF[1] * depth, ABOVE_USUAL * usual if np.isfinite(usual) else 0.0)

    @property
    def is_fit(self) -> bool:
        """Whether poses fit depth at all, so that single frames can be judged: most neighbours meet within 3 % of the
        depth."""
        pairs = [pair for pair in self.neighbours() if pair.found is not None]
        if len(pairs) < 3:
            return False
        good = [pair.moved < 0.03 * pair.found.depth for pair in pairs if pair.found]
        return float(np.mean(good)) > 0.5


def _same_pose(pair: FramePair) -> bool:
    return pair.distance < SAME_VIEW[0] and pair.angle < SAME_VIEW[1]


def same_pose_runs(world_from_cameras: Float[ndarray, "t 4 4"]) -> list[tuple[int, int]]:
    """First and last frame of each stretch of frames of one pose."""
    distance, angle = view_change(world_from_cameras[:-1], world_from_cameras[1:])
    same = (distance < SAME_VIEW[0]) & (angle < SAME_VIEW[1])
    edges = np.flatnonzero(np.diff(np.concatenate([[0], same, [0]])))
    return [(int(first), int(last)) for first, last in edges.reshape(-1, 2)]


def surfaces_apart(a: BlockPoints, b: BlockPoints) -> float:
    """Metres by which the surfaces of two frames of one pose lie apart beyond what counts as measured; 0 below that,
    and infinite where they have nothing in common."""
    found = aligned(a, b, np.eye(4))
    if found is None:
        shares = [np.isfinite(blocks.normals[..., 0]).mean() for blocks in (a, b)]
        return float("inf") if min(shares) > LEAST_SURFACE else 0.0
    return found.moved if found.moved > LEAST_OFF[0] + LEAST_OFF[1] * found.depth else 0.0


def repeated_poses(pairs: NeighbourPairs) -> list[WrongPose]:
    """Runs of frames of one pose whose surfaces are not those of one view."""
    usual = pairs.usual
    wrong = []
    for first, last in same_pose_runs(pairs.poses):
        if last - first + 1 == len(pairs):
            continue
        # What rests in view of a robot moves itself at times; a pose that hangs moves all of the image, over and over.
        ends = pairs.pair(first, last)
        if ends.moved > pairs.limit(ends) or (ends.found is None and _has_surface(pairs, ends)):
            shift, angle = (ends.found.shift, ends.found.angle) if ends.found else (np.nan, np.nan)
            numbers = pairs.frames[first].index, pairs.frames[last].index
            wrong.append(WrongPose(*numbers, shift, angle, usual))
    return wrong


def _has_surface(pairs: NeighbourPairs, pair: FramePair) -> bool:
    shares = [np.isfinite(pairs.frames[k].blocks.normals[..., 0]).mean() for k in (pair.i, pair.j)]
    return bool(min(shares) > LEAST_SURFACE)


def off_frames(pairs: NeighbourPairs) -> list[WrongPose]:
    """Single frames that lie far from both neighbours, while these lie near each other; at the ends of a recording,
    far from the two nearest."""
    wrong: list[WrongPose] = []
    n, usual = len(pairs), pairs.usual
    for k in range(n):
        if n < 4:
            break
        left, right = (k - 1, k + 1) if 0 < k < n - 1 else (1, 2) if k == 0 else (n - 3, n - 2)
        own = [pairs.pair(min(k, other), max(k, other)) for other in (left, right)]
        rest = pairs.pair(left, right)
        if rest.found is None or not np.isfinite(rest.moved) or rest.found.agree < STATIC:
            continue
        moved = [pair.moved if pair.found else _lost(pairs, pair, rest) for pair in own]
        if all(m > max(pairs.limit(pair), CLEARLY * rest.moved) for m, pair in zip(moved, own, strict=True)):
            best = min((pair for pair in own if pair.found), key=lambda pair: pair.moved, default=None)
            shift, angle = (best.found.shift, best.found.angle) if best and best.found else (np.nan, np.nan)
            number = pairs.frames[k].index
            wrong.append(WrongPose(number, number, shift, angle, usual))
    return wrong


def _lost(pairs: NeighbourPairs, pair: FramePair, rest: FramePair) -> float:
    """Infinite where a frame with surfaces has nothing in common with a neighbour although its neighbours have much
    in common with each other; NaN where nothing can be told."""
    much = rest.found is not None and rest.found.overlap > 0.4 and _has_surface(pairs, pair)
    return float("inf") if much else float("nan")


def path_breaks(pairs: NeighbourPairs, apart: set[int]) -> list[WrongPose]:
    """Steps between neighbouring frames that poses make and surfaces do not, and back again nowhere.

    Args:
        apart: numbers of frames that are wrong by themselves; their neighbours are compared with each other.
    """
    kept = [k for k, frame in enumerate(pairs.frames) if frame.index not in apart]
    usual = pairs.usual
    wrong = []
    for i, j in pairwise(kept):
        pair = pairs.pair(i, j)
        if pair.found is None or _same_pose(pair) or pair.found.agree < STATIC:
            continue
        # The step of the poses must itself be of the size of the error: a slow drift has no steps.
        if pair.moved > 1.5 * pairs.limit(pair) and pair.found.after < 0.7 * pair.found.before:
            numbers = pairs.frames[i].index, pairs.frames[j].index
            wrong.append(WrongPose(*numbers, pair.found.shift, pair.found.angle, usual))
    return wrong


def brightness_steps(pairs: NeighbourPairs) -> list[tuple[int, float]]:
    """Frames whose surfaces are brighter or darker than in the frame before, and the factor, for each pair of
    neighbours that shows it."""
    return [
        (pairs.frames[pair.j].index, float(np.exp(pair.found.gain)))
        for pair in pairs.neighbours()
        if pair.found and np.isfinite(pair.found.gain)
    ]


def far_pairs(pairs: NeighbourPairs) -> list[FramePair]:
    """Pairs of frames at least a quarter of the recording apart, of the most similar views."""
    n = len(pairs)
    i, j = np.triu_indices(n, max(4, n // 4))
    if not len(i):
        return []
    poses = pairs.poses
    distance, angle = view_change(poses[i], poses[j])
    depth = np.array([frame.typical_depth for frame in pairs.frames])
    distance = distance / np.fmin(depth[i], depth[j])
    change = distance / FAR_VIEW[0] + angle / FAR_VIEW[1]
    with np.errstate(invalid="ignore"):
        near = np.flatnonzero((distance < FAR_VIEW[0]) & (angle < FAR_VIEW[1]))
    # Spread over the recording: the best of each frame before the second best of any.
    order = near[np.argsort(change[near], kind="stable")]
    taken, used = [], np.zeros(n, int)
    for k in order:
        if used[i[k]] < 2 and used[j[k]] < 2:
            taken.append(k)
            used[[i[k], j[k]]] += 1
        if len(taken) == N_FAR:
            break
    return [pairs.pair(int(i[k]), int(j[k])) for k in taken]


def drift(pairs: NeighbourPairs) -> Drift | None:
    """How much frames far apart in time disagree; None if there are too few that see the same place.

    The square of the disagreement is taken as a sum of parts that grow with the square of the angle between the views,
    of the distance of the cameras, and with time: errors of depth and of the hand-eye calibration grow with the view.
    """
    far = [pair for pair in far_pairs(pairs) if pair.found and np.isfinite(pair.moved) and pair.found.overlap > 0.15]
    near = [
        pair
        for gap in (1, 2, 4)
        if gap < len(pairs)
        for pair in pairs.neighbours(gap)[:: max(1, gap // 2)]
        if pair.found and np.isfinite(pair.moved)
    ]
    if len(far) < 6 or len(near) < 6:
        return None
    every = near + far
    time = np.array([pairs.frames[pair.j].index - pairs.frames[pair.i].index for pair in every], float)
    parts = np.stack(
        [
            np.ones(len(every)),
            np.array([pair.angle for pair in every]) ** 2,
            np.array([pair.distance for pair in every]) ** 2,
            (time / time.max()) ** 2,
        ],
        axis=1,
    )
    squares = np.array([pair.moved for pair in every]) ** 2
    scale = parts.max(axis=0) + 1e-12
    # Robust: large disagreements count less, one lost pair must not decide.
    weight = 1 / (np.median(squares) + squares)
    share, _ = nnls(parts / scale * weight[:, None], squares * weight)
    grown = share[3] * (parts[len(near) :, 3] / scale[3])
    return Drift(
        near=float(np.median([pair.moved for pair in near])),
        far=float(np.median([pair.moved for pair in far])),
        by_time=float(np.sqrt(np.median(grown))),
        shift=float(np.median([pair.found.shift for pair in far if pair.found])),
        angle=float(np.median([pair.found.angle for pair in far if pair.found])),
        n_pairs=len(far),
    )
