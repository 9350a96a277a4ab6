"""Which reading of a recording its own depth supports: poses, unit, clock, intrinsics, and what depth measures.

Inverted poses, poses in other camera axes or units, and poses of the neighbouring frame pass every check of single
files. `core/readings.py` tells them apart; here it is asked about a recording that is being read.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from bask_data.core.readings import judge
from bask_data.core.readings_judgement import Offers
from bask_data.formats.options.common import SourceOptions
from bask_data.formats.recording import CameraRecording
from bask_data.formats.verdict import Agreement


def agreement(
    camera: CameraRecording,
    otherwise: Mapping[str, Float[ndarray, "t 4 4"]],
    options: SourceOptions,
    unit: float = 0.0,
) -> Agreement:
    """What the depth of some pairs of frames says about the given reading.

    Args:
        otherwise: `world_from_cameras` under other readings of the same files, by the options for them.
        options: those that it was read with.
        unit: metres per unit of the source's depth; that of `camera` unless given, which may be another.
    """
    judgement = judge(
        camera.n_frames,
        lambda i: camera.read_depth(i) * np.float32(camera.depth_scale),
        camera.Ks,
        camera.world_from_cameras,
        otherwise=otherwise,
        is_ray=options.depth_is == "ray",
    )
    offers = Offers(
        depth_scale=("--depth-scale" if options.has("depth_scale") else "", unit or camera.depth_scale),
        rays="--depth-is",
        intrinsics="--intrinsics" if options.has("intrinsics") else "",
    )
    return Agreement(judgement, offers, options.trust)
