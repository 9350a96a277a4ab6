"""Depth of a robomimic demonstration: metres, 16-bit units, MuJoCo's normalised depth, or as `export` writes it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy import ndarray

from bask_data.errors import BadData, UsageError
from bask_data.formats.hdf5 import StoredFrames
from bask_data.formats.options.robomimic import RobomimicOptions
from bask_data.formats.recording import Depth

BEYOND = 0.99
"""Share of the far plane from which on nothing was hit: MuJoCo's depth is 0.03 % off there."""

NORMALISED_MEDIAN = 0.9
"""Least median of normalised depth: whatever is ten times as far as the near plane (1 cm in robosuite) is above."""

N_RANGE_FRAMES = 3
"""Frames, spread over the demonstration, that tell metres from normalised depth. Chosen, sensitivity not measured."""


def robomimic_depth(
    path: Path, frames: StoredFrames, scale: float | None, options: RobomimicOptions
) -> tuple[Callable[[int], Depth], float, str]:
    """Depth of a frame, metres per unit of it, and a statement on it.

    Args:
        path: the file, for messages.
        scale: metres per unit of depth that was exported.
    """
    if frames.dtype.kind == "u":
        unit = scale or 0.001
        about = f"z-depth, integers of {unit * 1000:g} mm, 0 = no measurement"
        return lambda i: np.minimum(_flat(frames, i), 65535).astype(np.uint16), unit, about
    if scale is not None:
        # Float32 holds a product of 16 bits and the unit exactly enough to find the integer again.
        about = f"z-depth, metres in steps of {scale * 1000:g} mm, as it was exported; 0 = no measurement"
        return lambda i: _in_units(_flat(frames, i), scale), scale, about
    if _is_normalised(path, frames, options):
        near, far = _planes(options.planes)
        about = f"MuJoCo's normalised depth between {near:g} and {far:g} m; 1 = no measurement"
        return lambda i: _unnormalised(_flat(frames, i), near, far), 1.0, about
    far = BEYOND * options.far_plane
    about = f"z-depth, metres; from {far:g} m on, the far plane = no measurement"
    return lambda i: _before(_flat(frames, i), far), 1.0, about


def _is_normalised(path: Path, frames: StoredFrames, options: RobomimicOptions) -> bool:
    """Whether depth is MuJoCo's normalised one.

    Raises:
        BadData: it looks like it, and no option says whether it is.
    """
    if options.depth_unit != "auto" or options.planes:
        return options.depth_unit != "metres"
    looked_at = np.unique(np.linspace(0, len(frames) - 1, N_RANGE_FRAMES).astype(int))
    shown = [_flat(frames, int(i)) for i in looked_at]
    if max(float(depth.max()) for depth in shown) > 1 or np.median(shown) < NORMALISED_MEDIAN:
        return False
    raise BadData(
        path,
        frames.place,
        expected="depth in metres",
        got=f"values up to 1 with a median of {np.median(shown):.3f}, as normalised depth has",
        fix="pass --depth-unit normalised --planes NEAR,FAR (robosuite: 0.01 and 50 times the model's extent), or "
        "--depth-unit metres.",
    )


def _flat(frames: StoredFrames, i: int) -> ndarray:
    image = frames(i)
    return image[..., 0] if image.ndim == 3 else image


def _in_units(metres: ndarray, scale: float) -> Depth:
    units = np.rint(metres / np.float64(scale))
    return np.where((units >= 0) & (units <= 65535), units, 0).astype(np.uint16)


def _before(depth: ndarray, far: float) -> Depth:
    return np.where(depth < far, depth, 0).astype(np.float32)


def _unnormalised(depth: ndarray, near: float, far: float) -> Depth:
    """Source: robosuite's `get_real_depth_map`."""
    metres = near / (1 - depth.astype(np.float64) * (1 - near / far))
    return np.where((depth >= 0) & (metres < BEYOND * far), metres, 0).astype(np.float32)


def _planes(text: str) -> tuple[float, float]:
    try:
        near, far = (float(word) for word in text.split(","))
    except ValueError:
        near = far = 0.0
    if not 0 < near < far < np.inf:
        raise UsageError("--planes", expected="NEAR,FAR in metres", got=text or "nothing", fix="pass --planes 0.01,50.")
    return near, far
