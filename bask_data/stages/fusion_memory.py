"""The memory that a fusion will take, and a refusal that names what would fit."""

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
"""What reading and preparing one frame takes on top of the volume."""

USED_SHARE = 0.8
"""Of the memory that is free, unless `max_memory` says otherwise."""


def amount_of_memory(given: object) -> str:
    """An amount as `memory_limit` reads it: 4GB, 800MB, or empty.

    Raises:
        ValueError: it is none.
    """
    text = str(given).strip().upper()
    if not re.fullmatch(r"(\d+(\.\d+)?\s*([MG]B)?)?", text):
        raise ValueError("an amount of memory such as 4GB or 800MB")
    return text


@dataclass(frozen=True)
class Survey:
    """What a first look at some frames tells.

    Attributes:
        bounds: (2, 3) lowest and highest corner of the workspace, world frame, metres.
        blocks: (b, 3) voxel blocks that the frames looked at touch.
        n_blocks: how many all frames will.
        voxel_size: metres.
        truncation: voxels kept on both sides of a surface.
    """

    bounds: np.ndarray
    blocks: np.ndarray
    n_blocks: int
    voxel_size: float
    truncation: float


def most_blocks(survey: Survey, max_memory: str) -> int:
    """Voxel blocks that fit into the memory allowed; refuses when fewer than are expected."""
    from bask_data.core import tsdf

    begun, limit = resident_bytes(), memory_limit(max_memory)
    n_blocks = min(max(0, int((limit - begun - WORKING_BYTES) / tsdf.peak_bytes(1))), tsdf.MOST_BLOCKS)
    if n_blocks < survey.n_blocks:
        raise too_large(survey.n_blocks, begun, limit, survey)
    return n_blocks


def too_large(n_blocks: int, begun: int, limit: int, survey: Survey) -> UsageError:
    """The refusal, and what would fit."""
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
    """The smallest, of steps of a tenth, that takes 10 % less than so much memory; None if not ten times as large."""
    from bask_data.core import tsdf

    for factor in (1.1**k for k in range(1, 25)):
        share = tsdf.coarsening(survey.blocks, factor, survey.truncation)
        if tsdf.peak_bytes(math.ceil(1.1 * share * n_blocks)) <= n_bytes:
            return math.ceil(survey.voxel_size * factor * 1e4) / 1e4
    return None


def memory_limit(text: str) -> int:
    """Bytes: as given, in GB where no unit is, or a share of what the machine has free and this process holds."""
    match = re.fullmatch(r"([\d.]+)\s*([MG]B)?", text)
    if match:
        return int(float(match[1]) * (1e6 if match[2] == "MB" else 1e9))
    return resident_bytes() + int(USED_SHARE * _free_bytes())


def resident_bytes() -> int:
    """What this process holds in memory."""
    import psutil

    return int(psutil.Process().memory_info().rss)


def _free_bytes() -> int:
    """Of the machine, or of the container, which the machine's own figures know nothing of."""
    import psutil

    free = int(psutil.virtual_memory().available)
    group = Path("/sys/fs/cgroup")
    try:
        limit = (group / "memory.max").read_text().strip()
        if limit != "max":
            free = min(free, int(limit) - int((group / "memory.current").read_text()))
    except (OSError, ValueError):
        pass  # No Linux, or no container.
    return max(free, 0)


def _amount(n_bytes: int) -> str:
    return f"{n_bytes / 1e9:.2g}GB" if n_bytes >= 1e9 else f"{n_bytes / 1e6:.0f}MB"
