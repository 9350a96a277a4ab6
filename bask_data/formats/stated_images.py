"""What files state anew for each image although it hardly ever changes: intrinsics, and the unit of depth."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from bask_data.core.lens import one_if_same
from bask_data.formats.images import read_depth
from bask_data.formats.recording import Depth, SourceCamera


def intrinsics_of(stated: Sequence[Float[ndarray, "3 3"] | None]) -> Float[ndarray, "*t 3 3"]:
    """K of each image, or one if all are the same; images without one, which are bad, get that of another."""
    known = [K for K in stated if K is not None]
    Ks = np.stack([known[0] if K is None else K for K in stated])
    return one_if_same(Ks)


def scaled_depth(files: Sequence[Path], scales: Sequence[float | None]) -> tuple[float, Callable[[int], Depth]]:
    """Metres per unit, and what reads an image: raw depth if all have one unit, otherwise metres.

    Args:
        scales: metres per unit of each image; None for those that are never read.
    """
    different = {scale for scale in scales if scale is not None}
    if len(different) == 1:
        return different.pop(), lambda i: read_depth(files[i])

    def metres(i: int) -> Depth:
        scale = scales[i]
        assert scale is not None
        return read_depth(files[i]).astype(np.float32) * np.float32(scale)

    return 1.0, metres


def camera_assumptions(camera: SourceCamera) -> dict[str, str]:
    """What is said about depth and intrinsics of such a camera, whose depth lies on colour."""
    unit = "units that differ from image to image" if camera.depth_scale == 1 else f"{camera.depth_scale:g} m per unit"
    return {
        "depth": f"z-depth registered to colour, {unit}, 0 = no measurement",
        "intrinsics": "of each image, for colour and depth alike, no lens distortion",
    }
