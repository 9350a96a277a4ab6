"""Which reading of poses, units, intrinsics and clock the depth of a camera supports, and how sure that is.

Depth of a frame, warped into another under a hypothesis, meets what was measured there if the hypothesis is right. No
noise level is chosen, see `warped_depth`; hypotheses are compared pair of frames by pair of frames.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np
from jaxtyping import Float, Float32
from numpy import ndarray

from bask_data.core.geometry import invert_rigid
from bask_data.core.readings_hypotheses import Hypothesis
from bask_data.core.warped_depth import depth_view, evidence
from bask_data.findings import Finding


@dataclass(frozen=True)
class JudgeSettings:
    """How much is compared.

    Args:
        n_points: warped per pair of frames. Sensitivity not measured.
        n_pairs: about so many pairs of frames. Sensitivity not measured.
    """

    n_points: int = 900
    n_pairs: int = 36


@dataclass(frozen=True)
class Judgement:
    """What depth says about the way a camera's recording was read.

    Args:
        told, share: mean evidence, in [0, 1], of the recording as read and of the best hypothesis.
        best: the hypothesis that fits best; the default one is "as read".
        n_pairs: pairs of frames that were compared.
        sure_of_reading, sure_of_unit, sure_of_clock, sure_of_intrinsics: whether `best` beats all that differ in it.
        rivals: what cannot be told from the best one, in words.
    """

    told: float
    share: float
    best: Hypothesis
    n_pairs: int
    sure_of_reading: bool = False
    sure_of_unit: bool = False
    sure_of_clock: bool = False
    sure_of_intrinsics: bool = False
    rivals: tuple[str, ...] = ()
    codes: tuple[str, ...] = ()
    details: Mapping[str, str] = field(default_factory=dict)

    def findings(self, place: str) -> list[Finding]:
        """What is wrong, or cannot be told, with evidence; `place` is the camera: `table/wrist`."""
        return [Finding(code, place, self.details.get(code, "")) for code in self.codes]


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
        n_frames: t; only frames in pairs are read, at most some 70, in increasing order, each once.
        read_depth: z-depth of a frame as read, metres, 0 = no measurement. For a stored scan:
            `lambda i: camera.depth(i)` of `bask_data.kinds.Scan(path).cameras`, with its `Ks` and
            `world_from_cameras`.
        Ks: pixels.
        world_from_cameras: as read, OpenCV axes, metres.
        otherwise: `world_from_cameras` under other readings of the same files, by the options for them.
        is_ray: whether depth was read as the length of the ray, and converted.
    """
    starts = np.unique(np.linspace(0, max(n_frames - 2, 0), settings.n_pairs).astype(int))
    pairs = [(int(i), int(i) + 1) for i in starts if n_frames > 1]
    if not pairs:
        return Judgement(0.0, 0.0, Hypothesis(), 0, codes=("few-views",))
    views = {
        i: depth_view(read_depth(i), Ks[i], settings.n_points) for i in sorted({i for pair in pairs for i in pair})
    }
    poses = world_from_cameras
    told = float(np.mean([evidence(views[a], views[b], invert_rigid(poses[b]) @ poses[a]) for a, b in pairs]))
    return Judgement(told, told, Hypothesis(), len(pairs))
