"""Depth as LeRobot stores it: codes of 12 bits in videos, 16-bit or floating-point images, arrays."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, UInt16
from numpy import ndarray

from bask_data.errors import BadData
from bask_data.formats.lerobot.info import Feature
from bask_data.formats.poses import METRES_PER_UNIT

LARGEST_CODE = 4095
"""Largest code of depth in a video, 12 bits."""

DEFAULTS: dict[str, float | bool] = {"depth_min": 0.01, "depth_max": 10.0, "shift": 3.5, "use_log": True}
"""LeRobot's values, metres, where a video of 12 bits does not state them. Source: lerobot 0.6, DepthEncoderConfig."""

LARGEST_METRES = 1000.0
"""Bound on the stated range of depth, metres: beyond every sensor."""


@dataclass(frozen=True)
class DepthCodes:
    """The formula from codes to depth.

    Args:
        nearest, farthest: depth of the smallest and of the largest code, metres.
        shift: added to depth before its logarithm is taken, metres.
        is_stated: whether the dataset states it.
    """

    nearest: float
    farthest: float
    shift: float
    use_log: bool
    is_stated: bool

    @property
    def metres(self) -> Float32[ndarray, " n"]:
        """Depth by code.

        LeRobot has no code for no measurement: 0 becomes the smallest code with all that is too near, and what is too
        far becomes the largest one. Neither was measured.

        Source: lerobot 0.6, `dequantize_depth`.
        """
        share = np.arange(LARGEST_CODE + 1) / LARGEST_CODE
        if self.use_log:
            low, high = (math.log(end + self.shift) for end in (self.nearest, self.farthest))
            depth = np.exp(low + share * (high - low)) - self.shift
        else:
            depth = self.nearest + share * (self.farthest - self.nearest)
        depth[[0, LARGEST_CODE]] = 0.0
        return np.maximum(depth, 0.0).astype(np.float32)

    @property
    def statement(self) -> str:
        """The formula, in words."""
        kind = f"logarithmic with shift {self.shift:g} m" if self.use_log else "linear"
        where = "" if self.is_stated else ", LeRobot's defaults, as the files do not say"
        return (
            f"z-depth in 12-bit codes from {self.nearest:g} to {self.farthest:g} m, {kind}{where}; "
            "the smallest and the largest code = no measurement"
        )


def depth_codes(path: Path, feature: Feature) -> DepthCodes | None:
    """The formula that a video's feature states; None if it states none.

    Raises:
        BadData: it states one that gives no depth.
    """
    stated = {name: feature.info.get(f"video.{name}") for name in DEFAULTS}
    if all(value is None for value in stated.values()):
        return None
    values: dict[str, Any] = {name: DEFAULTS[name] if value is None else value for name, value in stated.items()}
    numbers = [values[name] for name in ("depth_min", "depth_max", "shift")]
    is_good = all(isinstance(n, int | float) and not isinstance(n, bool) and math.isfinite(n) for n in numbers)
    is_good = is_good and isinstance(values["use_log"], bool) and 0 <= numbers[0] < numbers[1] <= LARGEST_METRES
    if not is_good or (values["use_log"] and numbers[0] + numbers[2] <= 0):
        raise BadData(
            path,
            f"features.{feature.key}.info",
            expected="video.depth_min < video.depth_max in metres, a shift that keeps their logarithms finite, use_log",
            got=json.dumps(stated)[:200],
            fix="correct them in meta/info.json; LeRobot writes 0.01, 10.0, 3.5 and true.",
        )
    nearest, farthest, shift = map(float, numbers)
    return DepthCodes(nearest, farthest, shift, values["use_log"], is_stated=None not in stated.values())


def default_codes() -> DepthCodes:
    """LeRobot's formula, for a video of 12 bits that states none."""
    nearest, farthest, shift = (float(DEFAULTS[name]) for name in ("depth_min", "depth_max", "shift"))
    return DepthCodes(nearest, farthest, shift, use_log=True, is_stated=False)


def decoded_codes(path: Path, codes: UInt16[ndarray, "h w"], table: Float32[ndarray, " n"]) -> Float32[ndarray, "h w"]:
    """Depth, metres, of codes; `BadData` for values that are none."""
    largest = int(codes.max(initial=0))
    if largest >= len(table):
        raise BadData(path, "depth", expected=f"codes up to {len(table) - 1}", got=largest, fix="pass --depth-scale.")
    return table[codes]


def unit_of(feature: Feature, is_float: bool) -> tuple[float, str]:
    """Metres per unit of depth that is not in codes, and where that comes from.

    Source: lerobot 0.6 takes floating point for metres and whole numbers for millimetres.
    """
    stated = feature.info.get("depth_unit")
    if isinstance(stated, str) and stated in METRES_PER_UNIT:
        return METRES_PER_UNIT[stated], "as meta/info.json says"
    return (1.0, "LeRobot's rule for floating point") if is_float else (0.001, "LeRobot's rule for whole numbers")
