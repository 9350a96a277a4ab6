"""Pixels that show something which moves with the camera, such as a gripper."""

from __future__ import annotations

from collections.abc import Iterable

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8
from numpy import ndarray

from bask_data.core.visibility.labelled import LabelledSurface
from bask_data.core.visibility.sensor import MASK_TOLERANCE
from bask_data.core.visibility.surface import rays_of

N_CONFIRMING_RAYS = 40_000
"""Rays cast per frame in the search for what is fixed to the camera; every pixel would cost as much as the masks.
Chosen, sensitivity not measured."""

STEADY = 0.35
"""Share of the scene's standard deviation over the frames below which a pixel's grey value counts as constant. Chosen,
sensitivity not measured."""

LEAST_CHANGE = 8.0
"""Standard deviation of the scene's pixels over the frames, grey levels of 255, below which the camera hardly moved and
nothing is concluded. Chosen, sensitivity not measured."""


def confirmed(
    surface: LabelledSurface,
    depth: Float32[ndarray, "h w"],
    directions_camera: Float32[ndarray, "h w 3"],
    world_from_camera: Float[ndarray, "4 4"],
    tolerance: tuple[float, float] = MASK_TOLERANCE,
) -> Bool[ndarray, "h w"]:
    """Pixels whose measurement lies on the mesh, among an even sample of those that have one.

    Args:
        tolerance: (a, b): measurement and mesh agree within a + b z metres.
    """
    where = np.flatnonzero(depth)
    where = where[:: max(1, len(where) // N_CONFIRMING_RAYS)]
    seen = np.zeros(depth.shape, bool)
    if len(where):
        rendered, _ = surface.cast(rays_of(directions_camera, world_from_camera).at(where))
        here = depth.reshape(-1)[where]
        seen.reshape(-1)[where] = np.abs(rendered - here) <= tolerance[0] + tolerance[1] * here
    return seen


def fixed_to_camera(
    frames: Iterable[tuple[UInt8[ndarray, "h w 3"], Bool[ndarray, "h w"]]], height: int, width: int
) -> Bool[ndarray, "h w"]:
    """Pixels that show something which moves with the camera, such as a gripper's pads, which often give no depth.

    Such a pixel looks the same in every frame while the rest of the image changes, and its depth never lies on the
    reconstruction. By colour alone, a bare wall would pass; by depth alone, every hole of the sensor.

    Args:
        frames: colour, and the pixels whose depth is `confirmed`, of frames spread over a camera's path.
    """
    total, total_squared = np.zeros((height, width), np.float32), np.zeros((height, width), np.float32)
    n_confirmed = np.zeros((height, width), np.float32)
    n_frames = 0
    for rgb, is_confirmed in frames:
        grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
        total += grey
        total_squared += grey * grey
        n_confirmed += is_confirmed
        n_frames += 1
    nothing = np.zeros((height, width), bool)
    if n_frames < 3 or not n_confirmed.any():
        return nothing
    change = cv2.blur(np.sqrt(np.maximum(total_squared / n_frames - (total / n_frames) ** 2, 0)), (5, 5))
    scene_change = float(np.median(change[n_confirmed > 0]))
    if scene_change < LEAST_CHANGE:
        return nothing
    # Two confirmed pixels in a window of 25 over all frames may be stray; a pixel of the scene has dozens.
    confirmations = cv2.boxFilter(n_confirmed, -1, (5, 5), normalize=False, borderType=cv2.BORDER_CONSTANT)
    steady = ((change < STEADY * scene_change) & (confirmations <= 2)).astype(np.uint8)
    steady = cv2.morphologyEx(steady, cv2.MORPH_OPEN, np.ones((9, 9), np.uint8))
    # Both windows reach two pixels beyond the outline, and the opening rounds its corners.
    return cv2.dilate(steady, np.ones((7, 7), np.uint8)) > 0
