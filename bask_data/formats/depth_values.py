"""Depth as it is stored: 16-bit units, whatever the source has."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, UInt16
from numpy import ndarray

from bask_data.core.rotated_bits import BitPairs, bit_pairs
from bask_data.errors import BadData
from bask_data.formats.recording import Depth, SourceCamera

PLAUSIBLE_DEPTH = (0.001, 100.0)
"""Range of the median depth of an image, metres; outside it the unit must be wrong. Wrong units differ by a factor of
1000, and rooms measure metres."""

STEPS = (0.0001, 0.0002, 0.0005, 0.001)
"""Units for depth that the source holds in floating point, metres: the finest one that reaches far enough."""

N_DEPTHS = 8
"""Frames, spread over the recording, that the unit is chosen by. Sensitivity not measured."""

DEPTH_REACH = 1.5
"""A unit must reach this many times the largest depth of the frames looked at. Chosen; sensitivity not measured."""

ROTATED_FIX = (
    "`bask-data ingest apc` reads scenes of APC; otherwise write depth anew as (raw >> 3) | (raw << 13), in 16 bits, "
    "whose unit is 0.0001 m in APC and 0.001 m in SUN RGB-D."
)
"""What to do about rotated bits. No other scale is right for what lies beyond 8191 units."""

LARGEST = 65535
"""Largest 16-bit value."""


@dataclass(frozen=True)
class DepthValues:
    """How raw depth becomes 16-bit depth.

    Args:
        source_scale: metres per unit of the source.
        scale: metres per unit as stored.
        assumptions: what is lost by it.
    """

    source_scale: float
    scale: float
    assumptions: dict[str, str]

    def cleaned(self, raw: Depth) -> Depth:
        """Raw depth in which no measurement is 0."""
        if raw.dtype == np.uint16:
            return raw
        return np.where((raw > 0) & (raw < np.inf), raw, np.float32(0)).astype(np.float32, copy=False)

    def metres(self, raw: Depth) -> Float32[ndarray, "h w"]:
        """Depth in metres."""
        return raw.astype(np.float32) * np.float32(self.source_scale)

    def quantised(self, metres: Float32[ndarray, "h w"]) -> UInt16[ndarray, "h w"]:
        """Depth in stored units; what they do not reach is 0."""
        units = np.divide(metres, self.scale, dtype=np.float64)
        np.rint(units, out=units)
        units[~((units >= 0) & (units <= LARGEST))] = 0
        return units.astype(np.uint16)

    def stored(self, raw: Depth) -> UInt16[ndarray, "h w"]:
        """Depth in stored units, from 16 bits as they are or from the source's floating point."""
        return raw if raw.dtype == np.uint16 else self.quantised(self.metres(raw))


def depth_values(camera: SourceCamera, kept: list[int], *, has_scale_option: bool) -> DepthValues:
    """How a camera's depth is stored, by some of its frames.

    Args:
        has_scale_option: whether the format has `--depth-scale`, which an error may offer.

    Raises:
        BadData: no frame has a measurement, the bits are rotated, or the median is implausible at this scale.
    """
    looked_at = np.unique(np.linspace(0, len(kept) - 1, min(N_DEPTHS, len(kept))).astype(int))
    _check_bits(camera, [kept[int(k)] for k in looked_at])
    is_float, largest, checked = False, 0.0, False
    for k in [*looked_at, *np.setdiff1d(np.arange(len(kept)), looked_at)]:
        if checked and k not in looked_at:
            break
        raw = camera.depth(kept[int(k)])
        is_float = raw.dtype != np.uint16
        measured = raw[np.isfinite(raw) & (raw > 0)] if is_float else raw[raw > 0]
        if measured.size == 0:
            continue
        largest = max(largest, float(measured.max()) * camera.depth_scale)
        if not checked:
            _check_median(camera, kept[int(k)], float(np.median(measured)) * camera.depth_scale, has_scale_option)
            checked = True
        if not is_float:
            break
    if not checked:
        raise BadData(
            camera.name,
            "depth",
            expected="a measurement somewhere in the recording",
            got=f"none in {len(kept)} frames",
            fix="check the options that say where depth is, and which values mean no measurement.",
        )
    if not is_float:
        return DepthValues(camera.depth_scale, camera.depth_scale, {})
    reach = camera.farthest or DEPTH_REACH * largest
    scale = next((step for step in STEPS if step * LARGEST >= reach), STEPS[-1])
    text = (
        f"floating point in the source, kept in steps of {scale * 1000:g} mm; beyond {scale * LARGEST:.1f} m left out"
    )
    return DepthValues(camera.depth_scale, scale, {"depth values": text})


def _check_bits(camera: SourceCamera, frames: list[int]) -> None:
    """Refuse depth whose bits are surely rotated; `BadData`. Of other depth, one frame is looked at."""
    pairs = BitPairs()
    for i in frames:
        raw = camera.depth(i)
        if raw.dtype != np.uint16:
            return
        pairs += bit_pairs(raw)
        if raw.any() and not pairs.may_be_rotated:
            return
    if pairs.is_rotated:
        raise BadData(
            camera.name,
            "depth",
            expected="values that grow with the distance",
            got=f"multiples of 8 that start again at 1: {pairs.n_mended} of {pairs.n_jumps} jumps between neighbouring "
            "pixels by nearly all that 16 bits hold vanish if the bits are rotated by three: depth seems bit-rotated, "
            "as APC's [depth-rotated]",
            fix=ROTATED_FIX,
        )


def _check_median(camera: SourceCamera, i: int, median: float, has_scale_option: bool) -> None:
    if not PLAUSIBLE_DEPTH[0] <= median <= PLAUSIBLE_DEPTH[1]:
        raise BadData(
            f"{camera.name} {camera.frames[i]}",
            "depth",
            expected=f"a median between {PLAUSIBLE_DEPTH[0]:g} and {PLAUSIBLE_DEPTH[1]:g} m",
            got=f"{median:.4g} m at {camera.depth_scale:g} m per unit",
            fix="pass --depth-scale: 0.001 for millimetres."
            if has_scale_option
            else "check the files' depth: it is not in the unit that the format has.",
        )
