"""A model moved into the world of known poses of its images."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from bask_data.core.geometry import rotation_angle
from bask_data.core.similarity import similarity
from bask_data.errors import BadData
from bask_data.formats.files import listed

MOST_SCALE_RATIO = 1.2
"""Largest ratio of the scales by known poses and by depth, in either direction: noise of poses over a short path may
be a tenth of it, and wrong units are far beyond. Sensitivity not measured."""


def aligned_model(
    world_from_cameras: dict[str, Float[ndarray, "4 4"]],
    known: dict[str, Float[ndarray, "4 4"]],
    by: str,
    metres_per_unit: float,
) -> tuple[dict[str, Float[ndarray, "4 4"]], str]:
    """Poses, metres, moved into the world of known ones; and how well these agree, in words.

    Args:
        by: where the known poses come from, for the text.
        metres_per_unit: that the model was scaled by, for the text.

    Raises:
        BadData: fewer than three known poses belong to the cameras, or most of them contradict the model.
    """
    names = [name for name in known if name in world_from_cameras]
    ours, theirs = (
        np.array([poses[name] for name in names]).reshape(-1, 4, 4) for poses in (world_from_cameras, known)
    )
    try:
        free = similarity(ours, theirs)
    except ValueError as error:
        raise BadData(by, "--align-to", expected="poses of registered images", got=str(error)) from error
    if not 1 / MOST_SCALE_RATIO < free.scale < MOST_SCALE_RATIO:
        raise BadData(
            by,
            "--align-to",
            expected="poses and depth in the same unit",
            got=f"a world {free.scale:.3g} times as large by the known poses as by depth",
            fix="pass --depth-scale or --pose-unit; or the known poses are those of other images.",
        )
    fit = similarity(ours[free.inliers], theirs[free.inliers], scale=1.0)
    left = fit.moved(ours[free.inliers])[fit.inliers]
    right = theirs[free.inliers][fit.inliers]
    distance_mm = 1000 * np.linalg.norm(left[:, :3, 3] - right[:, :3, 3], axis=1)
    angle_deg = np.degrees(rotation_angle(np.swapaxes(left[:, :3, :3], 1, 2) @ right[:, :3, :3]))
    agreeing = np.flatnonzero(free.inliers)[fit.inliers]
    rejected = [name for i, name in enumerate(names) if i not in agreeing]
    text = (
        f"that of {by}: {len(agreeing)} of {len(names)} known poses agree"
        + (f" (not {listed(rejected)})" if rejected else "")
        + f", residuals median {np.median(distance_mm):.1f} mm and {np.median(angle_deg):.2f} degrees, "
        f"max {distance_mm.max():.1f} mm and {angle_deg.max():.2f} degrees; "
        f"by these poses the scale would be {free.scale * metres_per_unit:.9g} m per unit, {free.scale - 1:+.2%}; the "
        "one by depth is kept, so that poses fit depth"
    )
    return {name: fit.moved(pose) for name, pose in world_from_cameras.items()}, text
