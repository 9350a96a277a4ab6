"""The memory that a fusion needs, and an error that names what would fit."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from bask_data.errors import UsageError

if TYPE_CHECKING:
    import numpy as np

WORKING_BYTES = 100 * 2**20
"""Memory to read and prepare one frame, besides the volume. Chosen."""

USED_SHARE = 0.8
"""Share of the free memory to use, unless `max_memory` is given. Chosen."""


def amount_of_memory(given: object) -> str:
    """An amount of memory in the form that `memory_limit` reads: 4GB, 800MB, or empty.

    Raises:
        ValueError: it is not an amount of memory.
    """
    text = str(given).strip().upper()
    if not re.fullmatch(r"(\d+(\.\d+)?\s*([MG]B)?)?", text):
        raise ValueError("an amount of memory such as 4GB or 800MB")
    return text


@dataclass(frozen=True)
class Survey:
    """Estimates from a sample of the frames, before fusion.

    Attributes:
        bounds: (2, 3) lowest and highest corner of the workspace, world frame, metres.
        blocks: (b, 3) voxel blocks that the sample touches.
        n_blocks: estimated number of blocks that all frames touch.
        voxel_size: metres.
        truncation: distance around a surface in which the TSDF is kept, voxels.
        origin: (3,) where the lattice of voxels begins, world frame, metres.
    """

    bounds: np.ndarray
    blocks: np.ndarray
    n_blocks: int
    voxel_size: float
    truncation: float
    origin: np.ndarray


def most_blocks(survey: Survey, max_memory: str) -> int:
    """Number of voxel blocks that fit into the allowed memory.

    Raises:
        UsageError: fewer than the survey expects.
    """
    from bask_data.core import tsdf

    begun, limit = resident_bytes(), memory_limit(max_memory)
    n_blocks = min(max(0, int((limit - begun - WORKING_BYTES) / tsdf.peak_bytes(1))), tsdf.MOST_BLOCKS)
    if n_blocks < survey.n_blocks:
        raise too_large(survey.n_blocks, begun, limit, survey)
    return n_blocks


def too_large(n_blocks: int, begun: int, limit: int, survey: Survey) -> UsageError:
    """The error, and what would fit.

    Args:
        n_blocks: needed.
        begun, limit: bytes that the process held before, and may hold.
    """
    from bask_data.core import tsdf

    needed = begun + WORKING_BYTES + tsdf.peak_bytes(n_blocks)
    remedies = []
    room = min(limit - begun - WORKING_BYTES, tsdf.peak_bytes(tsdf.MOST_BLOCKS))
    if voxel_size := _voxel_size_that_fits(n_blocks, room, survey):
        size = " x ".join(f"{edge:.2f}" for edge in survey.bounds[1] - survey.bounds[0])
        remedies += [f"--voxel-size {voxel_size:g}", f"a --workspace smaller than {size} m"]
    if n_blocks > tsdf.MOST_BLOCKS:
        return UsageError(
            "reconstruct",
            "voxel_size",
            expected=f"at most {tsdf.MOST_BLOCKS} voxel blocks, which is what Open3D can count",
            got=f"about {n_blocks} at voxels of {survey.voxel_size * 1000:g} mm",
            fix=", or ".join(remedies or ["larger voxels"]) + ".",
        )
    remedies.append(f"--max-memory {_amount(math.ceil(needed * 1.1))}")
    return UsageError(
        "reconstruct",
        "max_memory",
        expected=f"at most {_amount(limit)}",
        got=f"a need of about {_amount(needed)} at voxels of {survey.voxel_size * 1000:g} mm",
        fix=", or ".join(remedies) + ".",
    )


def _voxel_size_that_fits(n_blocks: int, n_bytes: int, survey: Survey) -> float | None:
    """The smallest voxel size, in steps of a tenth, that needs 10 % less than so much memory; None if even voxels
    nearly ten times as large do not fit."""
    from bask_data.core import tsdf

    for factor in (1.1**k for k in range(1, 25)):
        share = tsdf.coarsening(survey.blocks, factor, survey.truncation)
        if tsdf.peak_bytes(math.ceil(1.1 * share * n_blocks)) <= n_bytes:
            return math.ceil(survey.voxel_size * factor * 1e4) / 1e4
    return None


def memory_limit(text: str) -> int:
    """Bytes that this process may hold: as given, in GB without unit, or by default what it holds and a share of the
    free memory."""
    match = re.fullmatch(r"([\d.]+)\s*([MG]B)?", text)
    if match:
        return int(float(match[1]) * (1e6 if match[2] == "MB" else 1e9))
    return resident_bytes() + int(USED_SHARE * _free_bytes())


def resident_bytes() -> int:
    """Resident memory of this process, bytes."""
    import psutil

    return int(psutil.Process().memory_info().rss)


def _free_bytes() -> int:
    """Free memory of the machine, or of the container if that is less, bytes."""
    import psutil

    free = int(psutil.virtual_memory().available)
    group = Path("/sys/fs/cgroup")
    try:
        limit = (group / "memory.max").read_text().strip()
        if limit != "max":
            free = min(free, int(limit) - int((group / "memory.current").read_text()))
    except (OSError, ValueError):
        pass  # Not Linux, or not a container.
    return max(free, 0)


def _amount(n_bytes: int) -> str:
    return f"{n_bytes / 1e9:.2g}GB" if n_bytes >= 1e9 else f"{n_bytes / 1e6:.0f}MB"
