"""Camera axes that few recordings have, and turned or mirrored images: looked at where nothing usual fits as well."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from bask_data.core.geometry import invert_rigid
from bask_data.core.readings_evidence import PairedViews, Trial
from bask_data.core.readings_hypotheses import Hypothesis, Readings
from bask_data.core.readings_search import COARSE_STEP, scales
from bask_data.core.readings_verdict import CLAIM_GAIN, CLAIM_P, beats
from bask_data.core.warped_depth import DepthView

N_UNUSUAL = 6
"""Of the unusual hypotheses, by a coarse search, that are compared in full. Sensitivity not measured."""

AXES = {
    "camera axes x left, y up (PyTorch3D) or images turned by 180 degrees": np.diag([-1.0, -1.0, 1.0, 1.0]),
    "camera axes x left, z backward": np.diag([-1.0, 1.0, -1.0, 1.0]),
    "images mirrored left to right": np.diag([-1.0, 1.0, 1.0, 1.0]),
    "images turned by 90 degrees clockwise": np.array([[0.0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]),
    "images turned by 90 degrees anticlockwise": np.array([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]),
    "camera axes x forward, y left (ROS: poses of camera_link, not of its optical frame)": np.array(
        [[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]]
    ),
}
"""From OpenCV's camera axes to those of the poses, by words for them. Images upside down without being turned are like
a left-handed world, which is among the usual readings."""


def with_unusual(readings: Readings) -> Readings:
    """The readings, and those with unusual axes in both directions."""
    poses, names = list(readings.poses), list(readings.names)
    for inverted in (False, True):
        told = invert_rigid(readings.poses[0]) if inverted else readings.poses[0]
        for words, told_from_camera in AXES.items():
            poses.append(told @ told_from_camera)
            names.append(Hypothesis(inverted, otherwise=words))
    return Readings(tuple(poses), tuple(names), readings.options)


def conversion(best: Hypothesis) -> str:
    """What makes world_from_camera of poses with unusual axes; empty for usual ones."""
    if best.otherwise not in AXES:
        return ""
    poses = "the inverse of each pose" if best.inverted else "each pose"
    told_from_camera = AXES[best.otherwise][:3, :3]
    if np.linalg.det(told_from_camera) < 0:
        return f"mirror colour and depth back, and use {poses}" if best.inverted else "mirror colour and depth back"
    rows = told_from_camera.astype(int).tolist()
    return f"multiply {poses} from the right by the rotation {rows}, or turn the images if it is they that are turned"


def is_unusual(
    views: dict[int, DepthView], pairs: Sequence[tuple[int, int]], readings: Readings, usual: Float[ndarray, " p"]
) -> bool:
    """Whether unusual axes, in any unit, fit clearly better than the best of the usual readings.

    Args:
        views: by frame.
        pairs: frames a and b.
        readings: the usual ones.
        usual: evidence of the best of them for each pair.
    """
    unusual = with_unusual(readings).poses[len(readings.poses) :]
    paired = PairedViews(views, pairs, unusual, (0,))
    trials = [Trial(reading, scale) for reading in range(len(unusual)) for scale in scales()]
    chosen = range(0, len(pairs), 2)
    coarse = paired.scores(trials, list(chosen), COARSE_STEP)[0].mean(axis=1)
    best = [trials[int(i)] for i in np.argsort(-coarse, kind="stable")[:N_UNUSUAL]]
    return any(beats(each, usual, CLAIM_P, CLAIM_GAIN) for each in paired.scores(best)[0])
