"""Depth files of transforms.json: 16-bit images, NumPy arrays and other floating-point depth, all in one unit."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bask_data.errors import BadData
from bask_data.formats.depth_files import read_any_depth
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
        """Raw depth of a frame.

        Raises:
            BadData: the file holds no depth, or floating-point depth that cannot be in this unit.
        """
        path = self.files[i]
        assert path is not None  # Frames without are among the faults, and never read.
        depth = read_any_depth(path)
        # Every fourth pixel: the median of all would take half as long as reading the file.
        measured = sampled[sampled > 0] if (sampled := depth[::4, ::4]).dtype == np.float32 else np.empty(0)
        if measured.size and (median := float(np.median(measured)) * self.scale) < LEAST_MEDIAN:
            raise BadData(
                path,
                "depth",
                expected=f"a median of at least {LEAST_MEDIAN:g} m",
                got=f"{median:.4g} m at {self.scale:g} m per unit",
                fix="pass --depth-scale 1 if the file holds metres.",
            )
        return depth
