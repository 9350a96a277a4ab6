"""Depth files of transforms.json: 16-bit images, or NumPy arrays."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bask_data.errors import BadData
from bask_data.formats.images import MAX_PIXELS, read_depth
from bask_data.formats.recording import Depth

LEAST_MEDIAN = 0.02
"""Median of floating-point depth, metres, below which its unit must be another: no camera measures nearer. Metres read
as millimetres lie below it up to 20 m."""


@dataclass(frozen=True)
class DepthFiles:
    """The depth files of the frames; None for a frame without.

    Args:
        scale: metres per unit.
    """

    files: tuple[Path | None, ...]
    scale: float

    def read(self, i: int) -> Depth:
        """Raw depth of a frame."""
        path = self.files[i]
        assert path is not None  # Frames without are among the faults, and never read.
        if path.suffix.lower() != ".npy":
            return read_depth(path)
        depth = _read_array(path)
        measured = depth[np.isfinite(depth) & (depth > 0)]
        if measured.size and float(np.median(measured)) * self.scale < LEAST_MEDIAN:
            raise BadData(
                path,
                "depth",
                expected=f"a median of at least {LEAST_MEDIAN:g} m",
                got=f"{np.median(measured) * self.scale:.4g} m at {self.scale:g} m per unit",
                fix="pass --depth-scale 1 if the array holds metres.",
            )
        return depth


def _read_array(path: Path) -> Depth:
    try:
        # Mapped into memory: what the header claims is not allocated before it is checked.
        array = np.load(path, mmap_mode="r", allow_pickle=False)
    except (ValueError, TypeError, SyntaxError, EOFError, OSError) as error:
        got = str(error).splitlines()[0][:200]
        raise BadData(path, "depth", expected="numbers saved by numpy.save", got=got) from error
    array = array[..., 0] if array.ndim == 3 and array.shape[2] == 1 else array
    if array.ndim != 2 or array.size > MAX_PIXELS or array.dtype.kind not in "fiu":
        raise BadData(path, "depth", expected="numbers (height, width)", got=f"{array.dtype} {array.shape}")
    return np.array(array, np.uint16 if array.dtype == np.uint16 else np.float32)
